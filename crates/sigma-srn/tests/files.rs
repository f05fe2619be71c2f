//! Model files that are not as they should be.

use proptest::prelude::*;
use sigma_srn::{Metadata, Model, ModelConfig};
use std::path::Path;

#[path = "../../data/tests/spoil/mod.rs"]
mod spoil;

#[test]
fn fuzz_model() {
    let config = ModelConfig { hidden: 2, latent: 3, instances: 2, tracing_steps: 4, density: true };
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.safetensors");
    let mut model = Model::init(&config, 1).unwrap();
    model.metadata.instance_names = vec!["a".into(), "b".into()];
    model.metadata.distances = Some([1.1, 1.5]);
    model.metadata.ray_sphere = Some(1.3);
    model.metadata.unexplained = [("a".into(), 0.1)].into();
    model.save(&path).unwrap();
    let good = std::fs::read(&path).unwrap();
    assert_eq!(Model::load(&path).unwrap(), model);
    spoil::fuzz("model", 400, &spoil::spoiled(), |spoiled| {
        match Model::from_bytes(&spoiled.of(&good), "", Path::new("model.safetensors")) {
            Ok(model) => {
                let tensors = model.tensors();
                prop_assert!(tensors.iter().all(|(_, shape, values)| shape.iter().product::<usize>() == values.len()));
                prop_assert!(tensors.iter().all(|(.., values)| values.iter().all(|value| value.is_finite())));
                prop_assert!(model.layout.tracing_steps >= 1);
            }
            Err(error) => prop_assert!(error.to_string().contains("model.safetensors") || error.to_string().contains("tensor")),
        }
        Ok(())
    });
}

/// What a renderer would take for colours, or allocate without end.
#[test]
fn outputs_and_marching_steps_are_checked() {
    use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("model.safetensors");
    let config = ModelConfig { hidden: 8, latent: 4, instances: 2, tracing_steps: 2, density: true };
    Model::init(&config, 1).unwrap().save(&path).unwrap();
    let good = std::fs::read(&path).unwrap();
    let (_, header) = SafeTensors::read_metadata(&good).unwrap();
    let metadata = header.metadata().clone().unwrap();
    let zeros = vec![0; 4096];
    let error = |longer: &str, steps: &str| {
        let view = |(name, view): (String, TensorView)| {
            let mut shape = view.shape().to_vec();
            shape[0] += usize::from(name.starts_with(longer));
            let bytes = &zeros[..4 * shape.iter().product::<usize>()];
            (name, TensorView::new(Dtype::F32, shape, bytes).unwrap())
        };
        let file = SafeTensors::deserialize(&good).unwrap();
        let tensors: Vec<_> = file.tensors().into_iter().map(|(name, tensor)| view((name.to_string(), tensor))).collect();
        let mut metadata = metadata.clone();
        metadata.insert("tracing_steps".into(), steps.into());
        let bytes = serialize(tensors.iter().map(|(name, view)| (name.as_str(), view)), Some(metadata)).unwrap();
        Model::from_bytes(&bytes, "", Path::new("model.safetensors")).map(|_| ()).map_err(|error| error.to_string())
    };
    assert_eq!(error("none", "2"), Ok(()));
    let names: Vec<String> = Model::load(&path).unwrap().tensors().into_iter().map(|(name, ..)| name).collect();
    for (network, outputs) in [("sigma.net.", "[1, 8]"), ("pixel_generator.net.", "[3, 8]")] {
        let last = names.iter().filter(|name| name.starts_with(network)).max().unwrap();
        let layer = last.rsplit_once('.').unwrap().0;
        let error = error(layer, "2").unwrap_err();
        assert!(error.contains(layer) && error.contains(outputs), "{error}");
    }
    let error = error("none", "4294967295").unwrap_err();
    assert!(error.contains("tracing_steps") && error.contains("1000"), "{error}");
}

#[test]
fn a_model_knows_how_far_away_its_cameras_were() {
    let known = |metadata: Metadata| [0.5, 0.99, 1.01, 1.6, 1.7].map(|distance| metadata.knows_distance(distance));
    let orbit_radius = Some(1.3);
    let distances = Some([1.1, 1.5]);
    assert_eq!(known(Metadata { orbit_radius, distances, ..Metadata::default() }), [false, false, true, true, false]);
    assert_eq!(known(Metadata { orbit_radius, ..Metadata::default() }), [false, false, false, true, false]);
    assert_eq!(known(Metadata::default()), [true; 5]);
    // Rays that begin on a sphere show the same from everywhere outside of the object.
    assert_eq!(
        known(Metadata { orbit_radius, distances, ray_sphere: Some(1.3), ..Metadata::default() }),
        [false, true, true, true, true]
    );
}
