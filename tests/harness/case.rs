use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use srn_plan::{BufferId, Builder, Element, Executor, ExecutorError, Plan, PlanError, Role, StageId};

#[derive(Clone, Debug)]
enum Values {
    F32(Vec<f32>),
    U32(Vec<u32>),
}

/// A small plan with a value for every input: what a kernel is tried on.
#[derive(Clone, Debug)]
pub struct Case {
    /// Its sizes, for messages.
    pub name: String,
    /// Buffers and steps, in one stage.
    pub plan: Plan,
    /// That stage.
    pub stage: StageId,
    inputs: Vec<(BufferId, Values)>,
}

impl Case {
    /// Writes the inputs, and poison into all other buffers: NaN, so that an element that a kernel leaves out or reads
    /// before it is written shows.
    pub fn fill(&self, executor: &mut dyn Executor) -> Result<(), ExecutorError> {
        for &id in self.plan.stage(self.stage).steps.iter().flat_map(|step| &step.buffers) {
            let buffer = self.plan.buffer(id);
            match (buffer.role, buffer.element) {
                (Role::Input, _) => {}
                (Role::Scratch, Element::F32) => executor.write(id, &vec![f32::NAN; buffer.len])?,
                (Role::Scratch, Element::U32) => executor.write_u32(id, &vec![0xdead_beef; buffer.len])?,
            }
        }
        self.inputs.iter().try_for_each(|(id, values)| match values {
            Values::F32(values) => executor.write(*id, values),
            Values::U32(values) => executor.write_u32(*id, values),
        })
    }
}

/// A [`Case`] in the making.
#[derive(Debug)]
pub struct Sketch {
    case: (String, StageId),
    builder: Builder,
    inputs: Vec<(BufferId, Values)>,
    random: Pcg64Mcg,
}

impl Sketch {
    /// An empty plan; the name also seeds the random inputs.
    pub fn new(name: impl Into<String>) -> Self {
        let name = name.into();
        let seed = name.bytes().fold(1, |seed: u64, byte| seed.wrapping_mul(31).wrapping_add(byte.into()));
        let mut builder = Builder::new(128 << 20);
        let stage = builder.stage("test");
        Sketch { case: (name, stage), builder, inputs: Vec::new(), random: Pcg64Mcg::seed_from_u64(seed) }
    }

    /// Numbers between -1 and 1.
    pub fn numbers(&mut self, len: usize) -> Vec<f32> {
        (0..len).map(|_| self.random.random_range(-1.0..1.0)).collect()
    }

    /// An input of [`numbers`](Self::numbers).
    pub fn random(&mut self, name: &str, len: usize) -> BufferId {
        let values = self.numbers(len);
        self.input(name, values)
    }

    /// An input of given values.
    pub fn input(&mut self, name: &str, values: Vec<f32>) -> BufferId {
        let id = self.builder.input(name, values.len()).expect("inputs of tests are small");
        self.inputs.push((id, Values::F32(values)));
        id
    }

    /// An input of random integers below `end`.
    pub fn indices(&mut self, name: &str, len: usize, end: u32) -> BufferId {
        let id = self.builder.input_u32(name, len).expect("inputs of tests are small");
        let values = (0..len).map(|_| self.random.random_range(0..end)).collect();
        self.inputs.push((id, Values::U32(values)));
        id
    }

    /// A buffer that a step must fill as a whole.
    pub fn scratch(&mut self, name: &str, len: usize) -> BufferId {
        self.builder.scratch(name, len).expect("buffers of tests are small")
    }

    /// An output: random where the kernel adds to it, poisoned where it overwrites it.
    pub fn output(&mut self, name: &str, len: usize, accumulate: bool) -> BufferId {
        if accumulate { self.random(name, len) } else { self.scratch(name, len) }
    }

    /// Appends steps.
    #[track_caller]
    pub fn step(&mut self, step: impl FnOnce(&mut Builder) -> Result<(), PlanError>) {
        step(&mut self.builder).unwrap_or_else(|error| panic!("{}: {error}", self.case.0));
    }

    /// Buffers of other types than the functions above make.
    pub fn builder(&mut self) -> &mut Builder {
        &mut self.builder
    }

    /// The finished case.
    #[track_caller]
    pub fn finish(self) -> Case {
        let (name, stage) = self.case;
        let plan = self.builder.finish().unwrap_or_else(|error| panic!("{name}: {error}"));
        Case { name, plan, stage, inputs: self.inputs }
    }
}
