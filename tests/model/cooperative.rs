//! Cooperative matrices, on a device that has them: used where they hardly change gradients, and only there.

use sigma_srn::photo::Shot;
use sigma_srn::{Engine, Gpu, Intrinsics, Method, Model, Options, Phase, Renderer, camera, estimate};
use srn_gpu::Choice;
use srn_tests::{cooperative_gpu, gpu};

const SIDE: u32 = 16;

/// The pose of a view of the shipped model, as `engine` finds it: degrees from the truth, and the loss.
fn found(engine: &Engine) -> (f64, f64) {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../assets/models/compact.safetensors");
    let model = &Model::load(path.as_ref()).unwrap();
    let intrinsics = Intrinsics { fx: 18.0, fy: 18.0, cx: 8.0, cy: 8.0, pixel_center: 0.0 };
    let truth = camera::fixed24(1.3)[13];
    let rendering = Renderer::new(&Engine::cpu(), model, 1, SIDE, SIDE).unwrap().render(&[1], &[(truth, intrinsics)], 0).unwrap();
    let turn = glam::DMat4::from_axis_angle(glam::DVec3::new(0.6, 0.0, 0.8), 0.2);
    let starts = vec![turn * truth];
    let query = Shot::whole(rendering.rgb, intrinsics, 1, SIDE).query(starts);
    let phases = vec![Phase { steps: 30, stride: 1, keep: usize::MAX, light: false, closer_look: false, outlines: false }];
    let options = Options {
        method: Method::Bfgs { soft: 1.0, grain: 0.0 },
        min_starts: 0,
        align: false,
        phases,
        anew: 0,
        settle: 0,
        seed: 0,
    };
    let estimate = estimate(engine, model, &[query], &options, |_| Ok(())).unwrap().remove(0);
    (camera::pose_error(&estimate.pose.to_matrix(), &truth).0, estimate.loss)
}

/// Always by cooperative matrices, be they faster or not.
fn cooperative(gpu: &Gpu) -> Engine {
    Engine::gpu(gpu.with_choice(Choice::Named("cooperative".into())))
}

#[test]
fn a_pose_is_found_by_cooperative_matrices() {
    let plain = Engine::gpu(gpu().clone());
    let without = found(&plain);
    assert_eq!((plain.cooperative_difference(), plain.is_cooperative()), (None, false), "not asked for");
    // Where the device has none, it said so when it was opened.
    let Some(gpu) = cooperative_gpu() else { return };
    let engine = cooperative(gpu);
    assert!(!engine.is_cooperative(), "not before the check");
    let with = found(&engine);
    let difference = engine.cooperative_difference().expect("checked by now");
    println!("{engine}: gradients differ by {difference:.1e}, {:.4}° from the truth, {:.4}° without", with.0, without.0);
    assert!(engine.is_cooperative() && difference > 0.0, "{difference}");
    assert!(engine.to_string().contains("cooperative"), "{engine}");
    assert!(with.0 < 0.1, "{}°", with.0);
}

#[test]
fn wrong_products_are_not_used() {
    let Some(gpu) = cooperative_gpu() else { return };
    let faulty = cooperative(&gpu.with_sources(|kernel, variant| {
        kernel.source(variant).replace("x_12 = coopMultiplyAdd(y1", "x_12 = coopMultiplyAdd(y0")
    }));
    let with_fault = found(&faulty);
    let difference = faulty.cooperative_difference().expect("checked by now");
    assert!(!faulty.is_cooperative() && difference > 0.01, "{difference}");
    // The plain forms in `f32`, as on a device without.
    assert_eq!(with_fault, found(&cooperative(&gpu.without_cooperative())));
}
