//! `bench [--quick] [--gpu] [--width 64|256] [--json] [--write]`: what a pose step, a training step and a picture cost on every executor, beside
//! the rate that the matrix library reaches in the same run, and beside PyTorch where `python3` (or the interpreter that `PYTHON` names) has it.
//! All that is compared takes turns, so that a busy minute of the machine meets all alike. `--gpu`: only there, ours and PyTorch's; `--width`: only
//! the nets of that width. `--write` puts the tables into `docs/performance.md`, all of them.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Instant, SystemTime};

use sigma_srn::{
    Descent, Engine, Gpu, Intrinsics, Loss, Method, Model, ModelConfig, Options, Outline, Phase, Pose6, Query, Rays, Renderer,
    Shape, Train, Trainer, TrainingBatch, camera, estimate, pixel_grid, stream,
};
use srn_gpu::KernelTime;
use srn_tests::between;
use srn_tests::peer::Peer;

const USAGE: &str = "usage: bench [--quick] [--gpu] [--width 64|256] [--json] [--write]";
const SIDE: u32 = 64;
const RAYS: u32 = SIDE * SIDE;
/// Hypotheses of a pose step, as in the paper's measurement.
const BATCH: u32 = 5;
const ADAM: Method = Method::Adam { loss: Loss::Mae, learning_rate: 0.01 };
/// Bytes for a training beside the default: an eighth of it, less than a third of what the parameters of the paper's width take with their
/// gradients and moments.
const SMALL_BUDGET: u64 = 256 << 20;
/// Rows of a tile where the CPU's kernels are timed alone: with some hundred, as they run, starting the threads would count most.
const ALONE_ROWS: u32 = 4096;
/// Turns of works that take tenths of a second, which are disturbed more, and of longer ones; and seconds from which one turn must do.
const MANY_TURNS: usize = 9;
const TURNS: usize = 3;
const LONG: f64 = 30.0;
/// Seconds of a turn, at least: a shorter work is done over and over, as a search does its steps. A step of a few milliseconds between others would find
/// none of its numbers in the cache.
const LEAST: f64 = 0.2;
/// Steps on a real GPU before their losses are read, as in a search, which reads at the end of a phase: while it does some, the CPU makes the next ready.
const UNREAD: u32 = 8;
/// Hypotheses and side of the image, from one to the other end of what is asked for.
const SCALING: [(u32, u32); 8] = [(5, 16), (5, 32), (5, 64), (5, 128), (1, 32), (5, 32), (24, 32), (120, 32)];

/// One line of the table.
#[derive(serde::Serialize)]
struct Row {
    work: String,
    width: u32,
    executor: &'static str,
    seconds: f64,
    /// Floating-point operations, matrix products only.
    flops: u64,
    /// Part of the matrix library's rate that was measured beside it.
    of_sgemm: f64,
    bytes: u64,
    budget: u64,
}

/// One line of the table of steps in PyTorch.
#[derive(serde::Serialize)]
struct PeerRow {
    /// `pose step` or `training step`.
    work: String,
    width: u32,
    /// `as released`: f evaluated again for the sum; `kept`: once.
    version: String,
    seconds: f64,
    /// `cpu` or `cuda`.
    device: &'static str,
}

/// One line of the table of costs against work: a pose step of Adam.
#[derive(serde::Serialize)]
struct Scaling {
    width: u32,
    executor: &'static str,
    hypotheses: u32,
    side: u32,
    rays: u32,
    seconds: f64,
}

/// Time of one kernel in one run of a stage.
#[derive(serde::Serialize)]
struct KernelRow {
    /// `pose step` or `training step`.
    work: &'static str,
    width: u32,
    executor: &'static str,
    kernel: String,
    steps: usize,
    seconds: f64,
    flops: u64,
}

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Something that is timed: it has taken so many seconds.
type Timed<'a> = Box<dyn FnMut() -> Result<f64> + 'a>;

/// A work of ours: its row of the table, without times yet.
struct Work {
    row: Row,
    once: Timed<'static>,
}

/// What one run finds.
#[derive(Default)]
struct Report {
    hardware: String,
    /// What PyTorch ran on.
    peers_on: Vec<String>,
    /// Rates of the matrix library.
    ceilings: Vec<f64>,
    rows: Vec<Row>,
    peers: Vec<PeerRow>,
    scaling: Vec<Scaling>,
    kernels: Vec<KernelRow>,
}

fn main() -> ExitCode {
    match run() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error}");
            ExitCode::from(2)
        }
    }
}

fn run() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let has = |flag: &str| arguments.iter().any(|argument| argument == flag);
    let (quick, only_gpu) = (has("--quick"), has("--gpu"));
    let mut widths = if quick { vec![64] } else { vec![64, 256] };
    let mut rest = arguments.iter().map(String::as_str);
    while let Some(argument) = rest.next() {
        match argument {
            "--quick" | "--gpu" | "--json" | "--write" => {}
            "--width" => match rest.next() {
                Some("64") => widths = vec![64],
                Some("256") => widths = vec![256],
                other => return Err(format!("{USAGE}, not --width {}", other.unwrap_or_default()).into()),
            },
            other => return Err(format!("{USAGE}, not {other}").into()),
        }
    }
    if has("--write") && (quick || only_gpu || widths.len() < 2) {
        return Err(
            "--write replaces the whole table of docs/performance.md: it goes with none of --quick, --gpu and --width".into()
        );
    }

    let mut engines = if only_gpu { vec![] } else { vec![Engine::cpu()] };
    match Gpu::open(None) {
        Ok(gpu) => engines.push(Engine::gpu(gpu)),
        Err(error) if only_gpu => return Err(error.into()),
        Err(error) => eprintln!("only the CPU executor: {error}"),
    }
    let mut report = Report { hardware: hardware(&engines), ..Report::default() };
    eprintln!("{}", report.hardware);
    let [many_turns, turns] = if quick { [1, 1] } else { [MANY_TURNS, TURNS] };
    // The small nets first: the kernels of the large ones are compiled then.
    for width in widths {
        let model = model(width)?;
        let benches: Vec<_> = engines.iter().map(|engine| Bench { engine, model: &model }).collect();
        let peers: Vec<_> = Peer::start(width, only_gpu, UNREAD)?.into_iter().map(RefCell::new).collect();
        report.peers_on = peers.iter().map(|peer| peer.borrow().runs_on.clone()).collect();

        let mut works = Vec::new();
        for bench in &benches {
            works.push(bench.pose_step(ADAM, BATCH, SIDE)?);
            if width == 64 {
                works.push(bench.pose_step(Method::Bfgs { soft: 0.3, grain: 0.0 }, BATCH, SIDE)?);
            }
            works.push(bench.picture()?);
        }
        let rows = report.take_turns(if width == 64 { many_turns } else { turns }, works, "pose step", &peers)?;
        report.rows.extend(rows);

        let mut works = Vec::new();
        for bench in &benches {
            works.push(bench.training_step()?);
            if !quick {
                let engine = bench.engine.clone().with_budget(SMALL_BUDGET);
                works.push(Bench { engine: &engine, ..*bench }.training_step()?);
            }
        }
        let rows = report.take_turns(turns, works, "training step", &peers)?;
        report.rows.extend(rows);
        drop(peers);

        for bench in &benches {
            if !quick {
                let works = SCALING.map(|(hypotheses, side)| bench.pose_step(ADAM, hypotheses, side));
                let works = works.into_iter().collect::<Result<_>>()?;
                let turns = if width == 64 && !bench.is_gpu() { many_turns } else { turns };
                let rows = report.take_turns(turns, works, "cost against work", &[])?;
                for ((hypotheses, side), Row { executor, seconds, .. }) in SCALING.into_iter().zip(rows) {
                    report.scaling.push(Scaling { width, executor, hypotheses, side, rays: hypotheses * side * side, seconds });
                }
            }
            report.kernels.extend(bench.profile(bench.name())?);
            if bench.is_gpu() {
                report.kernels.extend(bench.profile_training(bench.name())?);
            }
        }
        // Where there are cooperative matrices, a pose step with them, and what they change.
        if let Ok(gpu) = Gpu::open_cooperative(None) {
            let engine = Engine::gpu(gpu);
            let bench = Bench { engine: &engine, model: &model };
            let difference = bench.cooperative_difference()?;
            let rows = report.take_turns(turns, vec![bench.pose_step(ADAM, BATCH, SIDE)?], "cooperative matrices", &[])?;
            let so = if engine.is_cooperative() { "allowed" } else { "refused" };
            let named = |work| format!("{work}; cooperative matrices {so}, which change pose gradients by {difference:.1e}");
            report.rows.extend(rows.into_iter().map(|row| Row { work: named(row.work), ..row }));
            report.kernels.extend(bench.profile("gpu, cooperative")?);
        }
    }
    report.rows.sort_by_key(|row| (row.width, row.executor));
    let text = report.text() + &report.against_pytorch();
    match has("--json") {
        true => println!("{:#}", report.json()),
        false => println!("{text}"),
    }
    if has("--write") {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/performance.md");
        let new = between::replace(&std::fs::read_to_string(&path)?, "bench", &text)?;
        std::fs::write(&path, new)?;
    }
    Ok(())
}

impl Report {
    /// Works of ours, and the steps of the peers whose names begin with `what` they do, take turns: one that pays for first use, and `turns`
    /// that are timed, of [`LEAST`] seconds. The rows of ours; those of the peers are kept.
    fn take_turns(&mut self, turns: usize, works: Vec<Work>, what: &str, peers: &[RefCell<Peer>]) -> Result<Vec<Row>> {
        let (mut rows, mut all): (Vec<Row>, Vec<Timed>) = works.into_iter().map(|work| (work.row, work.once)).unzip();
        let width = rows[0].width;
        let mut peer_rows = Vec::new();
        for peer in peers {
            for name in peer.borrow().steps.iter().filter(|name| name.starts_with(what)) {
                let (work, version) = name.split_once(", ").ok_or_else(|| format!("bench/peer.py has a step {name}"))?;
                let device = peer.borrow().device;
                peer_rows.push(PeerRow { work: work.into(), width, version: version.into(), seconds: 0.0, device });
                let name = name.clone();
                all.push(Box::new(move || peer.borrow_mut().take(&name)));
            }
        }

        let mut times = vec![(Vec::new(), Vec::new()); all.len()];
        for turn in 0..=turns {
            match turn {
                0 => eprintln!("{what}, width {width}: first use"),
                _ => eprintln!("{what}, width {width}: turn {turn} of {turns}"),
            }
            for (work, (seconds, rates)) in all.iter_mut().zip(&mut times) {
                if turn > 1 && seconds[0] > LONG {
                    continue;
                }
                let rate = sgemm_rate();
                let mut times = vec![work()?];
                while times.iter().sum::<f64>() < LEAST {
                    times.push(work()?);
                }
                if turn > 0 {
                    seconds.extend(times);
                    rates.push(rate);
                }
            }
        }
        let mut medians = times.iter_mut().map(|(seconds, rates)| {
            self.ceilings.extend(&*rates);
            (median(seconds), median(rates))
        });
        for (row, (seconds, rate)) in rows.iter_mut().zip(&mut medians) {
            (row.seconds, row.of_sgemm) = (seconds, row.flops as f64 / seconds / rate);
        }
        for (row, (seconds, _)) in peer_rows.iter_mut().zip(medians) {
            row.seconds = seconds;
        }
        rows.iter().for_each(|row| eprintln!("{}", line(row)));
        for PeerRow { work, width, version, seconds, device } in &peer_rows {
            eprintln!("PyTorch on {device}, {version}: {work} at width {width} in {seconds:.3} s");
        }
        self.peers.extend(peer_rows);
        Ok(rows)
    }

    fn text(&mut self) -> String {
        let mut text = format!("{}. `cargo xtask bench`\n\n", self.hardware);
        let ceiling = median(&mut self.ceilings) / 1e9;
        text += &format!("Matrix library (`gemm`, 1536 × 1536 × 1536, all threads) in the same run: {ceiling:.0} GFLOP/s.\n\n");
        text += "| work, 64 × 64 pixels | width | executor | median time | GFLOP | GFLOP/s | of sgemm | plan of budget |\n";
        text += "|---|---|---|---|---|---|---|---|\n";
        self.rows.iter().for_each(|row| text += &format!("{}\n", line(row)));
        if !self.scaling.is_empty() {
            text += "\nCost against work, a pose step of Adam:\n\n";
            text += "| width | executor | hypotheses | side | rays | median time | µs a ray |\n|---|---|---|---|---|---|---|\n";
        }
        for Scaling { width, executor, hypotheses, side, rays, seconds } in &self.scaling {
            let each = 1e6 * seconds / f64::from(*rays);
            text += &format!("| {width} | {executor} | {hypotheses} | {side} | {rays} | {:.1} ms | {each:.2} |\n", 1e3 * seconds);
        }
        text += "\nKernels of a pose step of Adam, and on a GPU of a training step, each timed alone:\n\n";
        text += "| work | width | executor | kernel | steps | ms | GFLOP/s |\n|---|---|---|---|---|---|---|\n";
        for of_one in self.kernels.chunk_by(|a, b| (a.work, a.width, a.executor) == (b.work, b.width, b.executor)) {
            for KernelRow { work, width, executor, kernel, steps, seconds, flops } in of_one.iter().take(8) {
                let rate = if *flops == 0 { String::new() } else { format!("{:.1}", *flops as f64 / seconds / 1e9) };
                text += &format!("| {work} | {width} | {executor} | `{kernel}` | {steps} | {:.1} | {rate} |\n", 1e3 * seconds);
            }
        }
        text
    }

    /// The same steps in PyTorch, and how many times faster ours are.
    fn against_pytorch(&self) -> String {
        if self.peers.is_empty() {
            return String::new();
        }
        let mut text = format!(
            "\nThe same steps in PyTorch (`bench/peer.py`), by turns with ours: {}. `as released`: f is evaluated again for the sum, as in the authors' code; `kept`: it is not.\n\n",
            self.peers_on.join("; ")
        );
        text += "| work | width | PyTorch on | version | PyTorch | ours, cpu | faster | ours, gpu | faster |\n";
        text += "|---|---|---|---|---|---|---|---|---|\n";
        for PeerRow { work, width, version, seconds, device } in &self.peers {
            let ours = |executor: &str| {
                let is_it = |row: &&Row| row.width == *width && row.executor == executor && row.work.starts_with(work);
                // The first of a kind: Adam, and the default budget.
                let ours = self.rows.iter().find(is_it).map(|row| row.seconds);
                ours.map_or(" | ".into(), |ours| format!("{ours:.3} s | {:.2}", seconds / ours))
            };
            text +=
                &format!("| {work} | {width} | {device} | {version} | {seconds:.3} s | {} | {} |\n", ours("cpu"), ours("gpu"));
        }
        text
    }

    fn json(&mut self) -> serde_json::Value {
        serde_json::json!({
            "hardware": self.hardware, "sgemm_flops_per_second": median(&mut self.ceilings), "rows": self.rows,
            "scaling": self.scaling, "kernels": self.kernels, "pytorch_on": self.peers_on, "pytorch": self.peers,
        })
    }
}

/// The paper's nets, or the compact ones.
fn model(width: u32) -> Result<Model> {
    let latent = if width == 256 { 256 } else { 32 };
    let config = ModelConfig { hidden: width, latent, instances: 9, tracing_steps: 10, density: true };
    Ok(Model::init(&config, 1)?)
}

fn intrinsics(side: u32) -> Intrinsics {
    let side = f64::from(side);
    Intrinsics { fx: 1.1625 * side, fy: 1.1625 * side, cx: 0.5 * side, cy: 0.5 * side, pixel_center: 0.0 }
}

/// `pixels` of each of `images` pictures of `side` pixels.
fn rays(images: u32, side: u32, pixels: u32) -> Rays {
    let mut random = stream(0, 0);
    let mut rays = Rays::default();
    for camera in camera::fixed24(1.3).iter().cycle().take(images as usize) {
        rays.push(camera, &intrinsics(side), pixel_grid(side, side, 1).take(pixels as usize), &mut random);
    }
    rays
}

fn target(values: u32) -> Vec<f32> {
    (0..values).map(|k| (k * 7919 % 200) as f32 / 100.0 - 1.0).collect()
}

#[derive(Clone, Copy)]
struct Bench<'a> {
    engine: &'a Engine,
    model: &'a Model,
}

impl Bench<'_> {
    fn is_gpu(&self) -> bool {
        self.engine.as_gpu().is_some()
    }

    fn name(&self) -> &'static str {
        if self.is_gpu() { "gpu" } else { "cpu" }
    }

    /// What `once` does, taking so many steps.
    fn work(&self, work: &str, flops: u64, bytes: u64, steps: u32, mut once: impl FnMut() -> Result<()> + 'static) -> Work {
        let (width, executor, budget) = (self.model.layout.features(), self.name(), self.engine.budget());
        let row = Row { work: work.into(), width, executor, seconds: 0.0, flops, of_sgemm: 0.0, bytes, budget };
        let once = Box::new(move || {
            let begin = Instant::now();
            once()?;
            Ok(begin.elapsed().as_secs_f64() / f64::from(steps))
        });
        Work { row, once }
    }

    /// Steps before losses are read. What a CPU does it cannot make ready meanwhile, and what stays on the host waits for it anyway.
    fn unread(&self) -> u32 {
        match self.engine.as_gpu() {
            Some(gpu) if !gpu.adapter().is_software && self.engine.budget() > SMALL_BUDGET => UNREAD,
            _ => 1,
        }
    }

    fn descent(&self, method: Method, hypotheses: u32, side: u32) -> Result<Descent> {
        let pixels = side * side;
        let shape = Shape { hypotheses, width: side, height: side, instances: 1 };
        let mut descent = Descent::new(self.engine, self.model, shape, method)?;
        let target = target(3 * hypotheses * pixels);
        descent.set_targets(&[0], &vec![0; hypotheses as usize], &rays(hypotheses, side, pixels), &target, None)?;
        let poses = camera::fixed24(1.3).iter().cycle().take(hypotheses as usize).map(Pose6::from_matrix).collect::<Vec<_>>();
        descent.set_poses(&poses)?;
        Ok(descent)
    }

    fn pose_step(&self, method: Method, hypotheses: u32, side: u32) -> Result<Work> {
        let name = if matches!(method, Method::Adam { .. }) { "Adam" } else { "BFGS" };
        let mut descent = self.descent(method, hypotheses, side)?;
        let (work, flops) = (format!("pose step, {name}, {hypotheses} hypotheses"), descent.flops_per_step());
        let steps = self.unread();
        Ok(self.work(&work, flops, descent.bytes(), steps, move || {
            for _ in 0..steps {
                descent.evaluate()?;
                descent.descend()?;
            }
            descent.losses()?;
            Ok(())
        }))
    }

    /// What the search for a pose finds cooperative matrices to change in gradients, before it decides on them.
    fn cooperative_difference(&self) -> Result<f64> {
        let (starts, rgb) = (camera::fixed24(1.3)[..8].to_vec(), target(3 * RAYS));
        let query = Query {
            instance: 0,
            intrinsics: intrinsics(SIDE),
            width: SIDE,
            height: SIDE,
            rgb,
            weights: None,
            coverage: None,
            outline: Outline::AS_GIVEN,
            starts,
        };
        let phases = vec![Phase { steps: 0, stride: 4, keep: 1, light: false, closer_look: false, outlines: false }];
        estimate(self.engine, self.model, &[query], &Options { phases, min_starts: 0, ..Options::default() }, |_| Ok(()))?;
        Ok(self.engine.cooperative_difference().unwrap_or(f64::NAN))
    }

    fn trainer(&self) -> Result<(Trainer, TrainingBatch)> {
        const IMAGES: u32 = 10;
        let trainer = Trainer::new(self.engine, self.model.clone(), Train::Everything, IMAGES, RAYS)?;
        let instances = (0..IMAGES).map(|image| image % 9).collect();
        let batch =
            TrainingBatch { instances, rays: rays(IMAGES, SIDE, RAYS), target_rgb: target(3 * IMAGES * RAYS), weights: None };
        Ok((trainer, batch))
    }

    fn training_step(&self) -> Result<Work> {
        let (mut trainer, batch) = self.trainer()?;
        let plan = trainer.executor().plan();
        let flops = plan.stages.iter().flat_map(|stage| &stage.steps).map(|step| step.flops).sum();
        let bytes = plan.bytes();
        let steps = self.unread();
        Ok(self.work("training step, 10 images", flops, bytes, steps, move || {
            for _ in 0..steps {
                trainer.step(&batch, 1e-4)?;
            }
            trainer.losses()?;
            Ok(())
        }))
    }

    fn picture(&self) -> Result<Work> {
        let mut renderer = Renderer::new(self.engine, self.model, 1, SIDE, SIDE)?;
        let cameras = [(camera::fixed24(1.3)[3], intrinsics(SIDE))];
        // A fifth of a pose step is one picture forward and backward; only its time is reported.
        Ok(self.work("picture", 0, 0, 1, move || {
            renderer.render(&[0], &cameras, 0)?;
            Ok(())
        }))
    }

    /// Time of each kernel of a training step, on a GPU.
    fn profile_training(&self, executor: &'static str) -> Result<Vec<KernelRow>> {
        let width = self.model.layout.features();
        let (mut trainer, batch) = self.trainer()?;
        trainer.gradients(&batch)?;
        let times = trainer.profile()?.unwrap_or_default().into_iter();
        let row = |KernelTime { label: kernel, steps, seconds, flops }| KernelRow {
            work: "training step",
            width,
            executor,
            kernel,
            steps,
            seconds,
            flops,
        };
        Ok(times.map(row).collect())
    }

    /// Time of each kernel of a pose step: from the device's clock on a GPU, from ours on the CPU.
    fn profile(&self, executor: &'static str) -> Result<Vec<KernelRow>> {
        let width = self.model.layout.features();
        let row =
            |(kernel, (steps, seconds, flops))| KernelRow { work: "pose step", width, executor, kernel, steps, seconds, flops };
        let rows_alone = |engine: &Engine| if self.is_gpu() { engine.clone() } else { engine.clone().with_tile_rows(ALONE_ROWS) };
        let mut descent = Bench { engine: &rows_alone(self.engine), ..*self }.descent(ADAM, BATCH, SIDE)?;
        descent.evaluate()?;
        if let Some(times) = descent.profile()? {
            return Ok(times.into_iter().map(|time| row((time.label, (time.steps, time.seconds, time.flops)))).collect());
        }
        let running = descent.executor();
        let plan = running.plan().clone();
        let evaluate = plan.stages.iter().position(|stage| stage.name == "evaluate").expect("a descent evaluates");
        let mut times: BTreeMap<String, (usize, f64, u64)> = BTreeMap::new();
        for (index, step) in plan.stages[evaluate].steps.iter().enumerate() {
            let begin = Instant::now();
            running.run_step(plan.stage_id(evaluate), index)?;
            let (steps, seconds, flops) = times.entry(step.kernel.name.into()).or_default();
            *steps += 1;
            *seconds += begin.elapsed().as_secs_f64();
            *flops += step.flops;
        }
        let mut rows: Vec<KernelRow> = times.into_iter().map(row).collect();
        rows.sort_by(|a, b| b.seconds.total_cmp(&a.seconds));
        Ok(rows)
    }
}

/// Floating-point operations a second of the matrix library, with all threads, on a product that fits no cache; best of two.
fn sgemm_rate() -> f64 {
    const N: usize = 1536;
    let (a, b, mut c) = (vec![0.5f32; N * N], vec![0.25f32; N * N], vec![0f32; N * N]);
    let mut best = f64::INFINITY;
    for _ in 0..2 {
        let begin = Instant::now();
        let n = N as isize;
        // SAFETY: the three matrices have N × N values.
        unsafe {
            let (a, b, threads) = (a.as_ptr(), b.as_ptr(), gemm::Parallelism::Rayon(0));
            gemm::gemm(N, N, N, c.as_mut_ptr(), 1, n, false, a, 1, n, b, 1, n, 0.0, 1.0, false, false, false, threads);
        }
        best = best.min(begin.elapsed().as_secs_f64());
    }
    assert_eq!(c[N + 1], 0.125 * N as f32);
    2.0 * (N as f64).powi(3) / best
}

fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Processor, threads, adapter and date.
fn hardware(engines: &[Engine]) -> String {
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let cpu = info.lines().find(|line| line.starts_with("model name")).and_then(|line| line.split(": ").nth(1));
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let adapter = engines.iter().find_map(Engine::as_gpu).map_or("no adapter".into(), |gpu| gpu.adapter().to_string());
    format!("{}, {threads} threads; {adapter}; {}", cpu.unwrap_or(std::env::consts::ARCH).trim(), date())
}

/// Today in UTC: days since 1970-01-01 to year, month, day (Hinnant's civil_from_days).
fn date() -> String {
    let days = SystemTime::UNIX_EPOCH.elapsed().map_or(0, |time| time.as_secs() / 86_400) + 719_468;
    let (era, day_of_era) = (days / 146_097, days % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * day_of_year + 2) / 153;
    let (day, month) = (day_of_year - (153 * shifted + 2) / 5 + 1, if shifted < 10 { shifted + 3 } else { shifted - 9 });
    format!("{}-{month:02}-{day:02}", era * 400 + year_of_era + u64::from(month <= 2))
}

fn line(row: &Row) -> String {
    let seconds = if row.seconds < 0.1 { format!("{:.1} ms", 1e3 * row.seconds) } else { format!("{:.2} s", row.seconds) };
    let mut cells = vec![row.work.clone(), row.width.to_string(), row.executor.into(), seconds];
    if row.flops == 0 {
        cells.extend(["", "", "", ""].map(String::from));
    } else {
        cells.push(format!("{:.1}", row.flops as f64 / 1e9));
        cells.push(format!("{:.1}", row.flops as f64 / row.seconds / 1e9));
        cells.push(format!("{:.0} %", 100.0 * row.of_sgemm));
        cells.push(format!("{} of {} MiB", row.bytes >> 20, row.budget >> 20));
    }
    format!("| {} |", cells.join(" | "))
}
