// How far a ray's beginning lies from the eye, along the ray, and the derivatives of that; the direction's length is 1.
struct Beginning {
    distance: f32,
    d_eye: vec3<f32>,
    d_direction: vec3<f32>,
}

// Rays begin where their line enters the sphere around the origin, before or behind the eye; those that pass the origin by more
// than √(3/4) radii, half a radius before they are nearest to it. Without a sphere (radius 0) they begin at the eye.
fn ray_beginning(eye: vec3<f32>, direction: vec3<f32>, radius: f32) -> Beginning {
    if (radius == 0.0) {
        return Beginning(0.0, vec3(0.0), vec3(0.0));
    }
    let along = dot(eye, direction);
    let nearest = eye - along * direction;
    let half = sqrt(max(radius * radius - dot(nearest, nearest), 0.25 * radius * radius));
    let change = select(0.0, 1.0 / half, half > 0.5 * radius);
    return Beginning(-along - half, change * nearest - direction, -(1.0 + change * along) * eye);
}
