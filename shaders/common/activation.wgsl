// 1 / (1 + e^-x), finite for every x.
fn sigmoid(x: f32) -> f32 {
    return 1.0 / (1.0 + exp(-max(x, -80.0)));
}

// tanh without the overflow and the cancellation of the drivers' (e^x - e^-x) / (e^x + e^-x): odd polynomial near zero
// (coefficients of Cephes' tanhf), 1 - 2 / (e^2|x| + 1) further out, which is 1 beyond 15.
fn stable_tanh(x: f32) -> f32 {
    let a = min(abs(x), 15.0);
    let z = a * a;
    let p = (((-5.70498872745e-3 * z + 2.06390887954e-2) * z - 5.37397155531e-2) * z + 1.33314422036e-1) * z - 3.33332819422e-1;
    return select(sign(x) * (1.0 - 2.0 / (exp(2.0 * a) + 1.0)), x + x * z * p, a < 0.625);
}

// Of four values.
fn sigmoids(x: vec4<f32>) -> vec4<f32> {
    return vec4(sigmoid(x.x), sigmoid(x.y), sigmoid(x.z), sigmoid(x.w));
}

fn tangents(x: vec4<f32>) -> vec4<f32> {
    return vec4(stable_tanh(x.x), stable_tanh(x.y), stable_tanh(x.z), stable_tanh(x.w));
}
