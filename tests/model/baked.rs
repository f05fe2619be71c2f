//! Baked models: one instance's networks do what the whole model does with that instance.

use sigma_srn::{Descent, Engine, Error, Method, Model, ModelConfig, Options, Outline, Query, Renderer, Shape, Train, Trainer};
use sigma_srn::{camera, estimate};
use srn_tests::{assert_close, difference, gpu};

use crate::lockstep::{engines, share_buffers, step_by_step};
use crate::{INSTANCES, RAYS, SIZE, batch, intrinsics, model, poses};

/// The instance that is baked.
const WHICH: u32 = 2;

fn baked(density: bool) -> [(Model, u32); 2] {
    let whole = model(density);
    let baked = whole.bake(&[WHICH]).unwrap();
    [(whole, WHICH), (baked, 0)]
}

#[test]
fn it_renders_the_same() {
    let cameras: Vec<_> = poses(3).iter().map(|pose| (pose.to_matrix(), intrinsics())).collect();
    // Codes of three numbers: the hypernetwork's first layers then are as wide as those of points.
    let config = ModelConfig { hidden: 8, latent: 3, instances: INSTANCES, tracing_steps: 2, density: true };
    let short = Model::init(&config, 2).unwrap();
    for whole in [model(true), model(false), short] {
        // Weights are computed in f64 and rounded once; worst: 1.1e-7 on cpu64, 1.2e-6 on llvmpipe.
        for engine in [Engine::cpu_f64(), Engine::cpu(), Engine::gpu(gpu().clone())] {
            // More than are made at once.
            let baked = whole.bake(&[0, 1, 0, 1, 0, 1, 0, 1, WHICH]).unwrap();
            let [whole, baked] = [(&whole, [0, WHICH, 0]), (&baked, [0, 8, 2])].map(|(model, instances)| {
                Renderer::new(&engine, model, 3, SIZE[0], SIZE[1]).unwrap().render(&instances, &cameras, 7).unwrap()
            });
            for (name, got, want) in [("rgb", baked.rgb, whole.rgb), ("depth", baked.depth, whole.depth)] {
                println!("{engine}: {name} differs by {:.1e}", difference(&got, &want).unwrap());
                assert_close(name, &got, &want, 1e-5);
            }
        }
    }
}

/// The losses of a descent and their derivatives are those of the whole model.
#[test]
fn it_leads_the_same_way() {
    let batch = batch(3);
    for engine in [Engine::cpu(), Engine::gpu(gpu().clone())] {
        let [whole, baked] = baked(true).map(|(model, instance)| {
            let shape = Shape { hypotheses: 3, width: SIZE[0], height: SIZE[1], instances: 1 };
            let mut descent = Descent::new(&engine, &model, shape, Method::Bfgs { soft: 0.3, grain: 0.0 }).unwrap();
            descent.set_targets(&[instance], &[0; 3], &batch.rays, &batch.target_rgb, None).unwrap();
            descent.set_poses(&poses(3)).unwrap();
            descent.evaluate().unwrap();
            [descent.losses().unwrap(), descent.gradients().unwrap().concat()]
        });
        for (name, got, want) in ["losses", "gradients"].into_iter().zip(baked).zip(whole).map(|((a, b), c)| (a, b, c)) {
            let [got, want] = [got, want].map(|values| values.into_iter().map(|value| value as f32).collect::<Vec<_>>());
            println!("{engine}: {name} differ by {:.1e}", difference(&got, &want).unwrap());
            assert_close(name, &got, &want, 1e-4);
        }
    }
}

/// A search bakes the instances that it looks for by itself: the outcome is that of the baked model, to the last bit, whatever their numbers.
#[test]
fn it_finds_the_same_pose() {
    let truth = poses(1)[0].to_matrix();
    let engine = Engine::cpu();
    let whole = model(true);
    let mut renderer = Renderer::new(&engine, &whole, 1, SIZE[0], SIZE[1]).unwrap();
    let rgb = renderer.render(&[WHICH], &[(truth, intrinsics())], 0).unwrap().rgb;
    let found = |model: &Model, instances: [u32; 2]| {
        let query = |instance| Query {
            instance,
            rgb: rgb.clone(),
            weights: None,
            coverage: None,
            outline: Outline::AS_GIVEN,
            width: SIZE[0],
            height: SIZE[1],
            intrinsics: intrinsics(),
            starts: camera::neighbor4(&truth),
        };
        let options = Options::default().with_steps(6);
        let found = estimate(&engine, model, &instances.map(query), &options, |_| Ok(())).unwrap();
        found.iter().map(|found| (found.pose, found.loss)).collect::<Vec<_>>()
    };
    let both = found(&whole, [WHICH, 0]);
    assert_eq!(both, found(&whole.bake(&[0, WHICH]).unwrap(), [1, 0]));
    assert_ne!(both[0].1, both[1].1, "one of them is another object");
}

#[test]
fn every_kernel_of_its_plan_is_right() {
    let [_, (model, _)] = baked(true);
    let shape = Shape { hypotheses: 3, width: SIZE[0], height: SIZE[1], instances: 2 };
    let batch = batch(3);
    let [mut subject, mut reference] = engines().map(|engine| {
        let mut descent = Descent::new(&engine, &model, shape, Method::Bfgs { soft: 0.3, grain: 0.0 }).unwrap();
        descent.set_targets(&[0, 0], &[0, 1, 1], &batch.rays, &batch.target_rgb, None).unwrap();
        descent.set_poses(&poses(3)).unwrap();
        descent.evaluate().unwrap();
        descent
    });
    let (subject, reference) = (subject.executor(), reference.executor());
    share_buffers(subject, reference);
    let instances = step_by_step(subject, reference, "instances");
    assert_eq!(instances.into_keys().collect::<Vec<_>>(), ["embedding/forward"], "nothing but copies");
    for stage in ["begin", "evaluate"] {
        step_by_step(subject, reference, stage);
    }
}

/// The paper's networks; how long the codes were does not matter any more.
#[test]
fn its_file_is_small_and_reads_back() {
    let config = ModelConfig { hidden: 256, latent: 2, instances: 2, tracing_steps: 10, density: true };
    let baked = Model::init(&config, 1).unwrap().bake(&[1]).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("baked.safetensors");
    baked.save(&path).unwrap();
    let bytes = std::fs::metadata(&path).unwrap().len();
    println!("{bytes} bytes");
    assert!(bytes < 4_000_000, "{bytes} bytes");
    assert_eq!(Model::load(&path).unwrap(), baked);
    assert_eq!((baked.layout.instances, baked.instance("1").unwrap()), (1, 0));
}

/// Layers of as many rows, which have the weights and biases of a layer.
#[test]
fn a_file_that_is_none_is_told() {
    use safetensors::{Dtype, serialize, tensor::TensorView};
    let read = |shapes: &[[usize; 2]]| {
        let zeros = vec![0; 4096];
        let view = |shape: &[usize; 2]| TensorView::new(Dtype::F32, shape.to_vec(), &zeros[..4 * shape[0] * shape[1]]).unwrap();
        let layers = shapes.iter().enumerate().map(|(l, shape)| (format!("phi.layers.{l}"), view(shape)));
        let bytes = serialize(layers, Some([("tracing_steps".to_string(), "1".to_string())].into())).unwrap();
        Model::from_bytes(&bytes, "", "baked.safetensors".as_ref()).unwrap_err().to_string()
    };
    let uneven = read(&[[2, 20], [3, 30]]);
    assert!(uneven.contains("phi.layers.1") && uneven.contains("[2, 30]") && uneven.contains("[3, 30]"), "{uneven}");
    let no_layer = read(&[[2, 20], [2, 31]]);
    assert!(no_layer.contains("phi.layers.1") && no_layer.contains("5 inputs") && no_layer.contains("31"), "{no_layer}");
}

#[test]
fn it_has_nothing_to_train() {
    let [(whole, _), (baked, _)] = baked(true);
    let refused = |error: Error| assert!(error.to_string().contains("baked"), "{error}");
    for train in [Train::Everything, Train::Codes] {
        refused(Trainer::new(&Engine::cpu(), baked.clone(), train, 1, RAYS).err().unwrap());
    }
    refused(baked.with_new_instances(vec!["new".into()]).unwrap_err());
    refused(baked.codes().unwrap_err());
    refused(baked.bake(&[0]).unwrap_err());
    let error = whole.with_codes(vec!["new".into()], vec![0.0]).unwrap_err().to_string();
    assert!(error.contains("codes") && error.contains("1 values"), "{error}");
    assert!(whole.bake(&[INSTANCES]).unwrap_err().to_string().contains("the model has 4"));
}
