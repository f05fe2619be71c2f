//! Triangles with colours and textures, ready to be drawn.

use crate::error::{Error, Result};
use glam::{Affine3A, Mat3, Vec2, Vec3};
use image::RgbaImage;
use std::ops::Range;
use std::path::Path;

/// A corner of a triangle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vertex {
    /// Position in object units.
    pub position: Vec3,
    /// Unit normal; either side of the surface.
    pub normal: Vec3,
    /// RGB in [0, 1], as displayed (gamma-encoded); multiplies the texture.
    pub colour: Vec3,
    /// Texture coordinates, `(0, 0)` at the top left of the picture, repeating.
    pub uv: Vec2,
}

/// Consecutive vertices drawn with one texture.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Vertices of the part, three to a triangle.
    pub vertices: Range<usize>,
    /// Index into [`Mesh::textures`].
    pub texture: Option<usize>,
}

/// A triangle soup: vertices `3i, 3i+1, 3i+2` are a triangle, in either winding.
#[derive(Debug, Clone, Default)]
pub struct Mesh {
    /// The corners.
    pub vertices: Vec<Vertex>,
    /// The vertices, divided by texture.
    pub parts: Vec<Part>,
    /// The textures.
    pub textures: Vec<RgbaImage>,
    /// What was left out of the file, one line each.
    pub warnings: Vec<String>,
}

/// Which axis of a file points up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Up {
    /// +y, usual in OBJ files.
    Y,
    /// +z.
    Z,
    /// −y, LDraw.
    MinusY,
}

impl From<Up> for Mat3 {
    /// The rotation from the file's axes to ours, which leaves x as it is.
    fn from(up: Up) -> Self {
        Mat3::from_cols_array(&match up {
            Up::Y => [1., 0., 0., 0., 0., 1., 0., -1., 0.],
            Up::MinusY => [1., 0., 0., 0., 0., -1., 0., 1., 0.],
            Up::Z => [1., 0., 0., 0., 1., 0., 0., 0., 1.],
        })
    }
}

impl Mesh {
    /// Adds a triangle with a flat normal to the last part. Degenerate triangles are dropped.
    pub(crate) fn push_flat(&mut self, corners: [Vec3; 3], colour: Vec3) {
        let normal = (corners[1] - corners[0]).cross(corners[2] - corners[0]).normalize_or_zero();
        if normal != Vec3::ZERO {
            self.vertices.extend(corners.map(|position| Vertex { position, normal, colour, uv: Vec2::ZERO }));
        }
    }

    /// The mesh, if it has a triangle.
    pub(crate) fn with_faces(self, path: &Path) -> Result<Self> {
        if self.vertices.is_empty() { Err(Error::field(path, "faces", "at least one", "none")) } else { Ok(self) }
    }

    /// The corners of the bounding box.
    pub fn bounds(&self) -> [Vec3; 2] {
        let positions = || self.vertices.iter().map(|v| v.position);
        [positions().fold(Vec3::MAX, Vec3::min), positions().fold(Vec3::MIN, Vec3::max)]
    }

    /// Turns the mesh z-up, moves its bounding box to the origin and scales the box's diagonal to 1. `turn` is which axis of
    /// the file points up, or the whole rotation from the file's axes to ours.
    pub fn normalise(&mut self, turn: impl Into<Mat3>) {
        let turn = turn.into();
        let [low, high] = self.bounds();
        let scale = 1.0 / (high - low).length().max(f32::MIN_POSITIVE);
        let placed = Affine3A::from_mat3(turn * scale) * Affine3A::from_translation(-0.5 * (low + high));
        for vertex in &mut self.vertices {
            vertex.position = placed.transform_point3(vertex.position);
            vertex.normal = turn * vertex.normal;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn normalise_centres_scales_and_turns() {
        for (up, top) in [(Up::Y, Vec3::Y), (Up::Z, Vec3::Z), (Up::MinusY, -Vec3::Y)] {
            let mut mesh = Mesh::default();
            let shift = Vec3::new(5.0, -2.0, 1.0);
            mesh.push_flat([shift, shift + 2.0 * Vec3::X, shift + 3.0 * top], Vec3::ONE);
            mesh.normalise(up);
            let [low, high] = mesh.bounds();
            assert!((low + high).length() < 1e-6 && ((high - low).length() - 1.0).abs() < 1e-6);
            let apex = mesh.vertices[2];
            assert!((apex.position.z - 1.5 / 13f32.sqrt()).abs() < 1e-6, "{up:?}: {apex:?}");
            // The turn is a rotation: flat normals keep agreeing with the winding.
            let [a, b, c] = [0, 1, 2].map(|i| mesh.vertices[i].position);
            assert!((b - a).cross(c - a).normalize().dot(apex.normal) > 0.999_99);
        }
    }
}
