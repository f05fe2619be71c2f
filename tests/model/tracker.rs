//! From frame to frame: what is followed, what is lost and found again, and what is known of the frames' masks.

use glam::{DMat4, DVec3};
use sigma_srn::photo::Shot;
use sigma_srn::{Doubt, Effort, Engine, Intrinsics, Options, Outline, Query, Renderer, Search, Tracked, Tracker, camera};

use super::behaviour::{shipped_forklift, with_rim};

/// With frames of 28 pixels one of ten that follow another five degrees away is found more than a degree off, of 64 one of a hundred.
const SIDE: u32 = 56;

/// A camera that goes about the object by five degrees, jumps to another side, and goes on from there.
fn cameras() -> Vec<DMat4> {
    let start = camera::look_at_origin(DVec3::new(0.9, -0.75, 0.5));
    let degrees = [0.0, 5.0, 10.0, 15.0, 130.0, 135.0, 140.0f64];
    degrees.map(|degrees| DMat4::from_rotation_z(degrees.to_radians()) * start).into()
}

#[test]
fn an_object_is_followed_and_found_again() {
    let (ref model, instance, intrinsics) = shipped_forklift();
    let intrinsics = Intrinsics { fx: 66.0, fy: 66.0, cx: 28.0, cy: 28.0, ..intrinsics };
    let engine = Engine::cpu();
    let mut renderer = Renderer::new(&engine, model, 1, SIDE, SIDE).unwrap();
    let mut frame = |camera: &DMat4, intrinsics: Intrinsics, has_rim: bool| {
        let view = renderer.render(&[instance], &[(*camera, intrinsics)], 0).unwrap().rgb;
        let (rgb, coverage) = if has_rim { with_rim(&view, SIDE as usize) } else { (view, vec![]) };
        let coverage = has_rim.then_some(coverage);
        // Where to search for what is lost, some way off; what is not lost is not looked for there.
        let starts = vec![DMat4::from_rotation_z(-0.2) * *camera];
        let outline = Outline { dilation: 9.0, ..Outline::AS_GIVEN };
        Query { coverage, outline, ..Shot::whole(rgb, intrinsics, instance, SIDE).query(starts) }
    };
    let error = |found: &Tracked, truth: &DMat4| camera::pose_error(&found.found.world_from_camera, truth).0;
    let search = Search { accept: Some(0.25), ..Search::from(Options { min_starts: 0, ..Options::of(Effort::Fast) }) };

    let new = |search, rough| Tracker::new(&engine, model, instance, search, rough).unwrap();

    let mut tracker = new(search.clone(), None);
    let mut searched = Vec::new();
    for (number, camera) in cameras().iter().enumerate() {
        let next = tracker.next(frame(camera, intrinsics, false), |_| Ok(())).unwrap();
        println!("frame {number} {:.2}° off, {:.0} %", error(&next, camera), 100.0 * next.found.unexplained);
        assert!(next.found.is_trusted() && error(&next, camera) < 1.0, "frame {number}");
        if next.is_searched {
            searched.push(number);
        }
    }
    assert_eq!((searched, tracker.rim()), (vec![0, 4], None));

    // Nothing is good enough: no frame leads to the next.
    let mut tracker = new(Search { accept: Some(1e-9), ..search.clone() }, Some(cameras()[0]));
    for camera in &cameras()[..2] {
        let next = tracker.next(frame(camera, intrinsics, false), |_| Ok(())).unwrap();
        assert_eq!((next.is_searched, next.found.doubt), (true, Some(Doubt::Unexplained)));
    }

    // Who searches himself follows all the same, from what he says, and may look at a frame twice.
    assert!(
        tracker.expected().is_none() && tracker.follow(frame(&cameras()[0], intrinsics, false), |_| Ok(())).unwrap().is_none()
    );
    tracker.restart(cameras()[0]);
    assert_eq!(tracker.expected(), Some(cameras()[0]));
    for (k, camera) in cameras().iter().enumerate().take(4).skip(1) {
        let found = tracker.follow(frame(camera, intrinsics, false), |_| Ok(())).unwrap().unwrap();
        let again = tracker.again(frame(camera, intrinsics, false), |_| Ok(())).unwrap().unwrap();
        for (found, most) in [(found, 2.0), (again, 1.0)] {
            let off = camera::pose_error(&found.world_from_camera, camera).0;
            assert!(off < most && found.doubt == Some(Doubt::Unexplained), "frame {k}: {off}°");
        }
        // It goes on from the frame before, however often that was looked at.
        let off = camera::pose_error(&tracker.expected().unwrap(), &cameras()[k + 1]).0;
        assert!(k == 3 || off < 2.0, "after frame {k}: {off}°");
    }

    // How far off masks are is found out in the first frame and known in those that follow, also through a lens that shows more pixels of it.
    let mut tracker = new(search, Some(cameras()[0]));
    let mut next = |k: usize, intrinsics: Intrinsics| {
        let next = tracker.next(frame(&cameras()[k], intrinsics, true), |_| Ok(())).unwrap();
        assert!(!next.is_searched);
        ((tracker.rim().unwrap() * intrinsics.fx).dilation, next.found.estimate.outline.unwrap().dilation)
    };
    let (rim, dilation) = next(0, intrinsics);
    assert!((rim - dilation).abs() < 1e-9 && rim < -0.5 && rim > -1.5, "{rim} {dilation}");
    let nearer = Intrinsics { fx: 1.2 * intrinsics.fx, fy: 1.2 * intrinsics.fy, ..intrinsics };
    for (k, intrinsics, times) in [(1, intrinsics, 1.0), (2, nearer, 1.2)] {
        let (rim_there, dilation) = next(k, intrinsics);
        assert!((rim_there - times * rim).abs() < 1e-9 && (dilation - rim_there).abs() < 1e-9, "{rim_there} {dilation}");
    }

    let other = Query { instance: instance + 1, ..frame(&cameras()[0], intrinsics, false) };
    let error = tracker.next(other, |_| Ok(())).unwrap_err().to_string();
    assert!(error.starts_with("frame: shows instance"), "{error}");
}
