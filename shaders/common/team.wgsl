// A number for each of a lane's eight vectors.
struct Slots {
    a: vec4<f32>,
    b: vec4<f32>,
}

// Sums over the vectors of a row, 1, 2, 4 or 8 successive ones of each of eight lanes; all of them get their row's sum.
fn total(mine: Slots, per_row: u32) -> Slots {
    var a = mine.a;
    var b = mine.b;
    a = select(a, a + a.yxwz, per_row > 1u);
    b = select(b, b + b.yxwz, per_row > 1u);
    a = select(a, a + a.zwxy, per_row > 2u);
    b = select(b, b + b.zwxy, per_row > 2u);
    let both = a + b;
    a = select(a, both, per_row > 4u);
    b = select(b, both, per_row > 4u);
    a += subgroupShuffleXor(a, 1u);
    b += subgroupShuffleXor(b, 1u);
    a += subgroupShuffleXor(a, 2u);
    b += subgroupShuffleXor(b, 2u);
    a += subgroupShuffleXor(a, 4u);
    b += subgroupShuffleXor(b, 4u);
    return Slots(a, b);
}

// That of a vector.
fn pick(values: Slots, k: u32) -> f32 {
    let four = select(values.a, values.b, k > 3u);
    return four[k % 4u];
}
