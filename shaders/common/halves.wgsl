// f16 ends at 2^16 and has all its digits down to 2^-14 only: weights, as good as always below 2^7, are taken times 2^8 ...
const W_SCALE: f32 = 256.0;

// ... and rows times a power of two, here its exponent, that brings their largest value to between 2^14 and 2^15.
fn exponent(row: u32) -> u32 {
    return clamp(268u - (atomicLoad(&largest[row]) >> 23u), 1u, 253u);
}

// The first 11 digits: what f16 holds. By bits, since a driver may take there and back again for the number itself.
fn high(values: vec4<f32>) -> vec4<f32> {
    return bitcast<vec4<f32>>(bitcast<vec4<u32>>(values) & vec4(0xffffe000u));
}

fn most(values: vec4<f32>) -> f32 {
    return max(max(values.x, values.y), max(values.z, values.w));
}
