// Where the weights of a group begin, in elements.
fn weights_of(group: u32) -> u32 {
    if (params.weight_stride == 0u) {
        return 0u;
    }
    return slots[params.first_group + group] * params.weight_stride;
}
