// Number of this invocation in a one-dimensional grid of 64-wide workgroups, which the scheduler folds into two
// dimensions where there are more than 65,535 of them.
fn flat_index(workgroup: vec3<u32>, workgroups: vec3<u32>, local: vec3<u32>) -> u32 {
    return (workgroup.y * workgroups.x + workgroup.x) * 64u + local.x;
}

// Coordinates of this invocation in a two-dimensional grid of 8×8 workgroups. Successive lanes run along the longer side
// of the extent, so that a narrow one (ten rows, one feature) leaves few of them idle.
fn tile_index(workgroup: vec3<u32>, local: vec3<u32>, extent: vec2<u32>) -> vec2<u32> {
    return 8u * workgroup.xy + select(local.xy, local.yx, extent.y > extent.x);
}

// Where one of 64 invocations stands among eight by eight. Of four neighbours two have the same x, and two the same y: NVIDIA's GPUs load the vectors of
// such pairs together.
fn among_eight(index: u32) -> vec2<u32> {
    return vec2((index & 1u) | ((index >> 1u) & 6u), ((index >> 1u) & 1u) | ((index >> 3u) & 6u));
}
