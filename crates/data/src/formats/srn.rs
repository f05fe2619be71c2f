//! SRN folders as captures: what archives in the wild do to them is read here, and turned into what [`crate::srn`] trains on.

use super::{Collector, Format, ReadOptions, View, WriteOptions, Written};
use crate::camera::{Axes, Camera, unit_sphere_seen_from};
use crate::capture::{Capture, Frame, FrameRecord};
use crate::error::{Error, Result, read_text};
use crate::picture::{Picture, cut};
use crate::pixels::{decode, is_picture};
use crate::srn::{InstanceFiles, InstanceWriter, Intrinsics, SrnSet, picture_size, read_pose_unchecked, write_png};
use glam::DVec2;
use std::path::{Path, PathBuf};

/// Reads a set, or a single instance; one capture each.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Vec<Capture>> {
    SrnSet::open(path)?.instances.iter().map(|instance| read_instance(instance, options)).collect()
}

/// Reads one instance.
pub(crate) fn read_instance(files: &InstanceFiles, options: &ReadOptions) -> Result<Capture> {
    let mut found = Collector::new(files.name.clone(), Format::Srn, options);
    if files.views.is_empty() {
        found.skip(Error::field(&files.dir, "rgb/", "pictures", "none"));
    }
    for view in &files.views {
        let at = files.dir.join(&view.name);
        let (image, pose) = match (&view.rgb, &view.pose) {
            (Some(image), Some(pose)) => (image, pose),
            (Some(_), _) => {
                found.skip(format!("{}: picture without a pose", at.display()));
                continue;
            }
            _ => {
                found.skip(format!("{}: pose without a picture", at.display()));
                continue;
            }
        };
        let read = || -> Result<View> {
            let world_from_camera = read_pose_unchecked(pose)?;
            let place = (pose.as_path(), "pose".to_owned());
            let view = View {
                place,
                name: view.name.clone(),
                image: image.clone(),
                mask: None,
                world_from_camera,
                intrinsics: None,
                distortion: [0.0; 5],
                size: None,
            };
            if options.fov_deg.is_some() {
                return Ok(view);
            }
            let file = files.intrinsics_file(&view.name);
            if !file.exists() {
                return Err(Error::Missing { path: file, why: "give --fov where an archive has no intrinsics".into() });
            }
            let (intrinsics, inverted) = Intrinsics::parse(&file, &read_text(&file)?, picture_size(image)?)?;
            let ([fx, fy], [cx, cy]) = (intrinsics.focal, intrinsics.centre);
            let world_from_camera = if inverted { world_from_camera.inverse() } else { world_from_camera };
            Ok(View { world_from_camera, intrinsics: Some([fx, fy, cx, cy]), size: Some(intrinsics.size), ..view })
        };
        match read() {
            Ok(view) => found.add(view),
            Err(error) => found.skip(error),
        }
    }
    if let Some(record) = FrameRecord::read(&files.dir)? {
        (found.capture.object_id, found.capture.scene_id) = (record.object_id, record.scene_id);
        found.capture.record = Some(record);
    }
    Ok(found.capture)
}

/// Writes `dir`: pinhole pictures on white. Intrinsics stand in one file, or beside each view where views differ.
pub(super) fn write(capture: &Capture, dir: PathBuf, axes: Axes, options: &WriteOptions) -> Result<Written> {
    let writer = InstanceWriter::bare(&dir, options.replace)?;
    let mut written = Written { dir: dir.clone(), ..Written::default() };
    let mut cameras = vec![];
    let mut unmasked = 0;
    for frame in &capture.frames {
        match write_picture(frame, &writer.pictures(), options, &mut written.warnings, &mut unmasked) {
            Ok(Some(camera)) => cameras.push((frame.name.as_str(), camera)),
            Ok(None) => written.skipped.push(format!("{}: the mask is empty", frame.image.display())),
            // A bad picture is left out; a full disk is not.
            Err(error @ (Error::Image { .. } | Error::Field { .. })) => written.skipped.push(error.to_string()),
            Err(error) => return Err(error),
        }
    }
    if unmasked > 0 {
        let all = capture.frames.len();
        written.warnings.push(format!(
            "{}: {unmasked} of {all} pictures have no mask: their background stays (`sigma-data masks` makes masks)",
            dir.display()
        ));
    }
    let intrinsics = |camera: &Camera| {
        let [fx, fy, cx, cy] = camera.with_pixel_centre(0.0).intrinsics;
        Intrinsics { focal: [fx, fy], centre: [cx, cy], size: camera.size }
    };
    let shared = cameras.first().map(|(_, camera)| intrinsics(camera));
    match shared.filter(|first| cameras.iter().all(|(_, camera)| intrinsics(camera) == *first)) {
        Some(shared) => writer.intrinsics(&shared)?,
        None => cameras.iter().try_for_each(|(name, camera)| writer.view_intrinsics(name, &intrinsics(camera)))?,
    }
    cameras.iter().try_for_each(|(name, camera)| writer.pose(name, &axes.of_ours(camera.world_from_camera)))?;
    written.views = cameras.len();
    if written.views > 0 {
        writer.finish()?;
    }
    Ok(written)
}

/// The unit sphere's outline on the image plane, where the camera sees it whole.
fn sphere(camera: &Camera) -> Option<Vec<DVec2>> {
    let camera_from_world = camera.world_from_camera.inverse();
    let points = unit_sphere_seen_from(camera.world_from_camera.w_axis.truncate());
    let points = points.into_iter().map(|point| camera_from_world.transform_point3(point));
    let plane: Option<Vec<_>> = points.map(|p| (p.z > 0.1 * p.length()).then(|| DVec2::new(p.x, p.y) / p.z)).collect();
    plane.filter(|plane| !plane.is_empty())
}

/// Writes a picture as it is where nothing must be done to it; gives its camera, or nothing where the object is not seen.
fn write_picture(
    frame: &Frame,
    folder: &Path,
    options: &WriteOptions,
    warnings: &mut Vec<String>,
    unmasked: &mut usize,
) -> Result<Option<Camera>> {
    let camera = frame.camera.with_pixel_centre(0.0);
    if options.side.is_none() && frame.mask.is_none() && camera.is_pinhole() && is_picture(&frame.image) {
        decode(&frame.image)?;
        return super::copy_picture(frame, folder, &frame.name, false).map(|_| Some(camera));
    }
    let mut picture = Picture::open(&frame.image, frame.mask.as_deref())?;
    let to = match options.side {
        None => Some(Camera { distortion: [0.0; 5], ..camera }),
        Some(side) => {
            picture.guess_background();
            *unmasked += usize::from(!picture.is_masked());
            if picture.is_masked() {
                let points = picture.contour(&camera);
                let about = |what: &str| format!("{}: {what}", frame.image.display());
                match picture.edge_share() {
                    0.0 => {}
                    share if share < 0.5 => warnings.push(about("the object reaches the picture's edge; is it cut off?")),
                    _ => warnings.push(about("the mask takes in most of the picture's edge; is it inverted? Objects are white")),
                }
                cut(&camera, &points, options.margin, side)
            } else if let Some(outline) = sphere(&camera).filter(|_| options.placed) {
                cut(&camera, &outline, options.margin, side)
            } else {
                // Nothing tells where the object is: the largest square in the middle.
                let [w, h] = camera.size.map(|s| s as f64);
                let (middle, half) = (0.5 * (DVec2::new(w, h) - 1.0), 0.5 * w.min(h));
                let corners = [middle - half, middle + half];
                cut(&camera, &corners.map(|corner| camera.plane(corner)), 0.0, side)
            }
        }
    };
    let Some(to) = to else { return Ok(None) };
    write_png(&folder.join(format!("{}.png", frame.name)), &picture.resample(&camera, &to))?;
    Ok(Some(to.with_pixel_centre(0.0)))
}
