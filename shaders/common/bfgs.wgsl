// Places in the state of a search, STATE values for each pose: the upper triangle of B by rows; g, the loss and the pose where the loss
// was lowest; the step from there to the trial; and how long steps may be.
const STATE_GRADIENT: u32 = 21u;
const STATE_LOSS: u32 = 27u;
const STATE_POSE: u32 = 28u;
const STATE_STEP: u32 = 40u;
const STATE_RADIUS: u32 = 46u;
const STATE: u32 = 47u;
// More than any loss that is a number.
const NO_LOSS: f32 = 3.4e38;

// Place of entry (a, b), a ≤ b, in an upper triangle of 6 rows.
fn entry(a: u32, b: u32) -> u32 {
    return a * (11u - a) / 2u + b;
}
