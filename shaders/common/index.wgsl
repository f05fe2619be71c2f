// Number of this invocation in a one-dimensional grid of 64-wide workgroups, which the scheduler folds into two
// dimensions where there are more than 65,535 of them.
fn flat_index(workgroup: vec3<u32>, workgroups: vec3<u32>, local: vec3<u32>) -> u32 {
    return (workgroup.y * workgroups.x + workgroup.x) * 64u + local.x;
}
