// What each team has added up, of four rows; two sides, used by turns, so that none is written while it is read.
var<workgroup> of_teams: array<vec4<f32>, 8>;

// Teams of eight lanes that share rows.
fn teams_of_row() -> u32 {
    return select(select(1u, 2u, params.features > 64u), 4u, params.features > 128u);
}

// Sums over the lanes of four rows; all of them get it.
fn total(mine: vec4<f32>, index: u32, side: u32) -> vec4<f32> {
    var sum = mine;
    sum += subgroupShuffleXor(sum, 1u);
    sum += subgroupShuffleXor(sum, 2u);
    sum += subgroupShuffleXor(sum, 4u);
    let teams = teams_of_row();
    if (teams > 1u) {
        if (index % 8u == 0u) {
            of_teams[4u * side + index / 8u] = sum;
        }
        workgroupBarrier();
        let first = 4u * side + index / 8u / teams * teams;
        sum = of_teams[first] + of_teams[first + 1u];
        if (teams > 2u) {
            sum += of_teams[first + 2u] + of_teams[first + 3u];
        }
    }
    return sum;
}
