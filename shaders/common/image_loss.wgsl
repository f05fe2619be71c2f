// Kinds of image loss, the numbers of `ImageLossParams::kind`.
const MAE: u32 = 0u;
const MSE: u32 = 1u;
const NORM_L1: u32 = 2u;
const NORM_L2: u32 = 3u;
const CHARBONNIER: u32 = 4u;
