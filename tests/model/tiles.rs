//! How the work is cut does not change the result.

use sigma_srn::{Descent, Engine, Error, Method, Renderer, Train};
use srn_tests::{assert_close, difference, gpu};

use crate::{RAYS, SIZE, batch, descent, descent_by, intrinsics, methods, model, poses, trainer, weights};

/// Engines with the largest difference that passes, relative to the largest value of a tensor: other tiles, other order of sums.
fn engines() -> [(Engine, f64); 3] {
    // Worst 0 on cpu64 (results are read as f32), 2.3e-5 on cpu (GMSD), 3.4e-5 on llvmpipe (GMSD), where tiles of another size
    // may run other variants of the kernels.
    [(Engine::cpu_f64(), 1e-7), (Engine::cpu(), 1e-4), (Engine::gpu(gpu().clone()), 1e-4)]
}

/// Losses, poses' gradients and colours of a descent after one evaluation.
fn evaluated(mut descent: Descent) -> [Vec<f32>; 3] {
    descent.evaluate().unwrap();
    let losses = descent.losses().unwrap().iter().map(|&loss| loss as f32).collect();
    let gradients = descent.gradients().unwrap().as_flattened().iter().map(|&d| d as f32).collect();
    [losses, gradients, descent.rgb().unwrap()]
}

fn assert_same(what: &str, got: &[Vec<f32>; 3], want: &[Vec<f32>; 3], tolerance: f64) {
    for ((name, got), want) in ["losses", "gradients", "colours"].iter().zip(got).zip(want) {
        println!("{:.1e}: {what}, {name}", difference(got, want).unwrap_or(f64::NAN));
        assert_close(&format!("{what}, {name}"), got, want, tolerance);
    }
}

#[test]
fn many_tiles_give_the_descent_of_one() {
    const HYPOTHESES: u32 = 5;
    for (engine, tolerance) in engines() {
        for method in methods() {
            let whole = evaluated(descent(&engine.clone().with_tile_rows(u32::MAX), method, HYPOTHESES));
            // Two images and a rest, parts of an image, single rows.
            for rows in [2 * RAYS + 5, 40, 11] {
                let tiled = evaluated(descent(&engine.clone().with_tile_rows(rows), method, HYPOTHESES));
                assert_same(&format!("{engine}, {method:?}, tiles of {rows}"), &tiled, &whole, tolerance);
            }
        }
    }
}

#[test]
fn poses_that_are_only_compared_give_the_same_in_less_memory() {
    const HYPOTHESES: u32 = 5;
    for (engine, tolerance) in engines() {
        for method in methods() {
            let [mut moving, mut still] = [Descent::new, Descent::still].map(|new| descent_by(new, &engine, method, HYPOTHESES));
            assert!(3 * still.bytes() < 2 * moving.bytes(), "{} of {} bytes", still.bytes(), moving.bytes());
            moving.compare().unwrap();
            still.evaluate().unwrap();
            still.descend().unwrap();
            assert_eq!(still.gradients().unwrap(), Vec::<[f64; 6]>::new());
            let [(losses, rgb), (still_losses, still_rgb)] =
                [moving, still].map(|mut descent| (descent.losses().unwrap(), descent.rgb().unwrap()));
            match method {
                Method::Bfgs { .. } => assert_eq!((still_losses, still_rgb), (losses, rgb), "{engine}"),
                // Whose matrices come from six numbers in `f32`.
                Method::Adam { .. } => assert_close(&format!("{engine}, {method:?}"), &still_rgb, &rgb, tolerance.max(1e-6)),
            }
        }
    }
}

#[test]
fn a_small_memory_budget_gives_the_same_and_is_kept() {
    const HYPOTHESES: u32 = 5;
    for (engine, tolerance) in engines() {
        for method in methods() {
            let whole = descent(&engine, method, HYPOTHESES);
            // The budget counts the executor's own bytes, eight per element in f64.
            let factor = if engine.to_string() == "cpu64" { 2 } else { 1 };
            let budget = factor * whole.bytes() / 3;
            let small = descent(&engine.clone().with_budget(budget), method, HYPOTHESES);
            assert!(factor * small.bytes() <= budget, "{} of {budget} bytes", factor * small.bytes());
            assert_same(&format!("{engine}, {method:?}, {budget} bytes"), &evaluated(small), &evaluated(whole), tolerance);
        }
    }
}

#[test]
fn a_budget_that_nothing_fits_is_an_error_with_both_numbers() {
    let engine = Engine::cpu().with_budget(1000);
    match Renderer::new(&engine, &model(true), 1, SIZE[0], SIZE[1]) {
        Err(Error::Budget { budget: 1000, needed }) => assert!(needed > 1000),
        Err(other) => panic!("{other}"),
        Ok(_) => panic!("fits into 1000 bytes"),
    }
}

#[test]
fn the_budget_that_an_error_names_is_enough() {
    // Many more rays than a plan has tiles.
    let side = 512;
    let rendered = |budget| Renderer::new(&Engine::cpu().with_budget(budget), &model(true), 1, side, side);
    let Err(Error::Budget { needed, .. }) = rendered(1 << 20) else { panic!("fits into 1 MiB") };
    assert!(rendered(needed).is_ok());
    assert!(matches!(rendered(needed - 1), Err(Error::Budget { needed: again, .. }) if again == needed));
}

#[test]
fn many_tiles_give_the_training_gradients_of_one() {
    const IMAGES: u32 = 5;
    for (engine, tolerance) in engines() {
        let gradients = |rows| {
            let mut trainer = trainer(&engine.clone().with_tile_rows(rows), model(true), Train::Everything, IMAGES);
            trainer.gradients(&batch(IMAGES)).unwrap();
            let total = trainer.losses().unwrap().total();
            (total, trainer.read_gradients().unwrap())
        };
        let (whole_total, whole) = gradients(u32::MAX);
        for rows in [2 * RAYS + 5, 40] {
            let (total, tiled) = gradients(rows);
            assert!((total / whole_total - 1.0).abs() < tolerance);
            let mut worst = 0.0f64;
            for ((name, got), (_, want)) in tiled.iter().zip(&whole) {
                assert_close(&format!("{engine}, tiles of {rows}, d {name}"), got, want, tolerance);
                worst = worst.max(difference(got, want).unwrap());
            }
            println!("{worst:.1e}: {engine}, tiles of {rows}, gradients of the parameters");
        }
    }
}

#[test]
fn many_starts_in_one_plan_give_what_each_gives_alone() {
    const STARTS: u32 = 24;
    let cases = engines().into_iter().flat_map(|case| methods().into_iter().map(move |method| (case.clone(), method)));
    for ((engine, tolerance), method) in cases {
        // Six equations multiply the rounding of their numbers by their condition: worst 2.2e-5 on cpu.
        let tolerance = if matches!(method, Method::Adam { .. }) { tolerance } else { 10.0 * tolerance };
        let mut together = descent(&engine, method, STARTS);
        let mut all = vec![];
        let batch = batch(STARTS);
        for start in 0..STARTS as usize {
            let mut alone = descent(&engine, method, 1);
            let part = |values: &[f32], width: usize| values[start * width..(start + 1) * width].to_vec();
            let mut rays = batch.rays.clone();
            rays.intrinsics.truncate(1);
            rays.uv = part(&rays.uv, 2 * RAYS as usize);
            rays.z0 = part(&rays.z0, RAYS as usize);
            let instances = [1, 2, 3];
            let target = part(&batch.target_rgb, 3 * RAYS as usize);
            let weights = weights(method, STARTS).map(|weights| part(&weights, RAYS as usize));
            alone.set_targets(&instances, &[batch.instances[start] - 1], &rays, &target, weights.as_deref()).unwrap();
            alone.set_poses(&poses(STARTS)[start..=start]).unwrap();
            all.push(refined(&mut alone));
        }
        let alone = [0, 1].map(|k| all.iter().flat_map(|one| one[k].clone()).collect::<Vec<f32>>());
        let together = refined(&mut together);
        for k in 0..2 {
            let name = format!("{engine}, {method:?}, {}", ["losses", "poses"][k]);
            println!("{:.1e}: {name}", difference(&together[k], &alone[k]).unwrap());
            assert_close(&name, &together[k], &alone[k], tolerance);
        }
    }
}

/// Losses and poses after a few steps, so few that rounding has no time to part them.
fn refined(descent: &mut Descent) -> [Vec<f32>; 2] {
    for _ in 0..3 {
        descent.evaluate().unwrap();
        descent.descend().unwrap();
    }
    let losses = descent.losses().unwrap().iter().map(|&loss| loss as f32).collect();
    [losses, descent.poses().unwrap().into_iter().flat_map(|pose| pose.to_f32()).collect()]
}

#[test]
fn many_tiles_give_the_picture_of_one() {
    for (engine, tolerance) in engines() {
        let render = |rows| {
            let cameras: Vec<_> = poses(3).into_iter().map(|pose| (pose.to_matrix(), intrinsics())).collect();
            let engine = engine.clone().with_tile_rows(rows);
            let mut renderer = Renderer::new(&engine, &model(true), 3, SIZE[0], SIZE[1]).unwrap();
            renderer.render(&[2, 0, 2], &cameras, 7).unwrap()
        };
        let (whole, tiled) = (render(u32::MAX), render(17));
        assert_close("colours", &tiled.rgb, &whole.rgb, tolerance);
        assert_close("depths", &tiled.depth, &whole.depth, tolerance);
    }
}
