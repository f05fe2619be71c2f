// Eight rows of a tile, four features of each; in a gradient of weights eight output features by four input features.
struct Eight {
    r0: vec4<f32>,
    r1: vec4<f32>,
    r2: vec4<f32>,
    r3: vec4<f32>,
    r4: vec4<f32>,
    r5: vec4<f32>,
    r6: vec4<f32>,
    r7: vec4<f32>,
}

// Adds the products of `w` with the vectors that the eight lanes from `first` on hold: row k gets lane k's.
fn multiply_add(sum: ptr<function, Eight>, w: mat4x4<f32>, mine: vec4<f32>, first: u32) {
    (*sum).r0 += w * subgroupShuffle(mine, first);
    (*sum).r1 += w * subgroupShuffle(mine, first + 1u);
    (*sum).r2 += w * subgroupShuffle(mine, first + 2u);
    (*sum).r3 += w * subgroupShuffle(mine, first + 3u);
    (*sum).r4 += w * subgroupShuffle(mine, first + 4u);
    (*sum).r5 += w * subgroupShuffle(mine, first + 5u);
    (*sum).r6 += w * subgroupShuffle(mine, first + 6u);
    (*sum).r7 += w * subgroupShuffle(mine, first + 7u);
}
