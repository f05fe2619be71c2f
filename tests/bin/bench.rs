//! `bench [--quick] [--json] [--write]`: what a pose step, a training step and a picture cost on every executor, beside the rate
//! that the matrix library reaches in the same run, and beside PyTorch where `python3` (or the interpreter that `PYTHON` names) has it. `--write` puts the tables into `docs/performance.md`.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use std::time::{Instant, SystemTime};

use sigma_srn::{
    Descent, Engine, Gpu, Intrinsics, Loss, Method, Model, ModelConfig, Options, Phase, Pose6, Query, Rays, Renderer, Shape,
    Train, Trainer, TrainingBatch, camera, estimate, pixel_grid, stream,
};
use srn_tests::between;
use srn_tests::peer::{Peer, PeerRow};

const USAGE: &str = "usage: bench [--quick] [--json] [--write]";
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
/// Hypotheses and side of the image, from one to the other end of what is asked for.
const SCALING: [(u32, u32); 8] = [(5, 16), (5, 32), (5, 64), (5, 128), (1, 32), (5, 32), (24, 32), (120, 32)];

/// One line of the table.
#[derive(Clone, Debug)]
struct Row {
    what: String,
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

/// One line of the table of costs against work: a pose step of Adam at width 64.
struct Scaling {
    executor: &'static str,
    hypotheses: u32,
    side: u32,
    seconds: f64,
}

impl Scaling {
    fn rays(&self) -> u32 {
        self.hypotheses * self.side * self.side
    }
}

/// Time of one kernel in one run of a stage.
struct KernelRow {
    width: u32,
    executor: &'static str,
    label: String,
    steps: usize,
    seconds: f64,
    flops: u64,
}

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

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
    if let Some(other) = arguments.iter().find(|argument| !["--quick", "--json", "--write"].contains(&argument.as_str())) {
        return Err(format!("{USAGE}, not {other}").into());
    }
    let has = |flag: &str| arguments.iter().any(|argument| argument == flag);
    let (quick, json) = (has("--quick"), has("--json"));

    let mut engines = vec![Engine::cpu()];
    match Gpu::open(None) {
        Ok(gpu) => engines.push(Engine::gpu(gpu)),
        Err(error) => eprintln!("only the CPU executor: {error}"),
    }
    let hardware = hardware(&engines);
    eprintln!("{hardware}");
    let peer = Peer::find();
    let (mut peer_on, mut peer_rows) = (String::new(), Vec::new());
    let (mut rows, mut kernels, mut ceilings, mut scaling) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    // The small nets first: the kernels of the large ones are compiled then.
    for width in if quick { vec![64] } else { vec![64, 256] } {
        let model = model(width)?;
        for engine in &engines {
            // What takes a tenth of a second is disturbed more.
            let runs = match width {
                _ if quick => 1,
                64 if engine.as_gpu().is_none() => 9,
                _ => 3,
            };
            let mut bench = Bench { engine, model: &model, runs, ceilings: &mut ceilings };
            let (row, mut descent) = bench.pose_step(ADAM, BATCH, SIDE)?;
            if engine.as_gpu().is_none() {
                let engine = engine.clone().with_tile_rows(ALONE_ROWS);
                let mut alone = Bench { engine: &engine, model: &model, runs: 1, ceilings: &mut Vec::new() };
                descent = alone.pose_step(ADAM, BATCH, SIDE)?.1;
            }
            kernels.extend(profile(&mut descent, width, name(engine))?);
            drop(descent);
            let before = rows.len();
            rows.push(row);
            if width == 64 {
                rows.push(bench.pose_step(Method::Bfgs { soft: 0.3 }, BATCH, SIDE)?.0);
            }
            // Long, and of two budgets.
            bench.runs = runs.div_ceil(3);
            rows.push(bench.training_step()?);
            if !quick {
                let engine = engine.clone().with_budget(SMALL_BUDGET);
                let mut bench = Bench { engine: &engine, model: &model, runs: 1, ceilings: &mut ceilings };
                rows.push(bench.training_step()?);
            }
            let mut bench = Bench { engine, model: &model, runs, ceilings: &mut ceilings };
            rows.push(bench.picture()?);
            rows[before..].iter().for_each(|row| eprintln!("{}", line(row)));
            // At once after ours, for machines are slower at some times than at others.
            if let Some(peer) = peer.as_ref().filter(|_| engine.as_gpu().is_none()) {
                let (on, measured) = peer.time(width)?;
                measured.iter().for_each(|row| {
                    eprintln!(
                        "PyTorch {}, {}: {} at width {} in {:.3} s",
                        row.device, row.version, row.work, row.width, row.seconds
                    )
                });
                peer_on = on;
                peer_rows.extend(measured);
            }
            if width == 64 && !quick {
                for (hypotheses, side) in SCALING {
                    let (row, _) = bench.pose_step(ADAM, hypotheses, side)?;
                    scaling.push(Scaling { executor: row.executor, hypotheses, side, seconds: row.seconds });
                }
            }
        }
        // Where there are cooperative matrices, a pose step with them, and what they change.
        if let Ok(gpu) = Gpu::open_cooperative(None) {
            let engine = Engine::gpu(gpu);
            let mut bench = Bench { engine: &engine, model: &model, runs: if quick { 1 } else { 3 }, ceilings: &mut ceilings };
            let difference = bench.cooperative_difference()?;
            let (row, mut descent) = bench.pose_step(ADAM, BATCH, SIDE)?;
            kernels.extend(profile(&mut descent, width, "gpu, cooperative")?);
            let so = if engine.is_cooperative() { "allowed" } else { "refused" };
            let what = format!("{}; cooperative matrices {so}, which change pose gradients by {difference:.1e}", row.what);
            rows.push(Row { what, ..row });
            eprintln!("{}", line(&rows[rows.len() - 1]));
        }
    }
    let ceiling = median(&mut ceilings);
    let mut text = report(&hardware, ceiling, &rows, &scaling, &kernels);
    text += &against_pytorch(&peer_on, &peer_rows, &rows);
    if json {
        println!("{:#}", as_json(&hardware, ceiling, &rows, &scaling, &kernels, &peer_rows));
    } else {
        println!("{text}");
    }
    if has("--write") {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../docs/performance.md");
        let new = between::replace(&std::fs::read_to_string(&path)?, "bench", &text)?;
        std::fs::write(&path, new)?;
    }
    Ok(())
}

/// The paper's nets, or the compact ones.
fn model(width: u32) -> Result<Model> {
    let latent = if width == 256 { 256 } else { 32 };
    let config = ModelConfig { hidden: width, latent, instances: 9, tracing_steps: 10, density: true };
    Ok(Model::init(&config, 1)?)
}

fn name(engine: &Engine) -> &'static str {
    if engine.as_gpu().is_some() { "gpu" } else { "cpu" }
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

struct Bench<'a> {
    engine: &'a Engine,
    model: &'a Model,
    runs: usize,
    ceilings: &'a mut Vec<f64>,
}

impl Bench<'_> {
    /// Median seconds of several runs, with the rate of the matrix library measured before each.
    fn measure(&mut self, mut work: impl FnMut() -> Result<()>) -> Result<(f64, f64)> {
        work()?;
        let (mut seconds, mut rates) = (Vec::new(), Vec::new());
        for _ in 0..self.runs {
            rates.push(sgemm_rate());
            let begin = Instant::now();
            work()?;
            seconds.push(begin.elapsed().as_secs_f64());
        }
        self.ceilings.extend(&rates);
        Ok((median(&mut seconds), median(&mut rates)))
    }

    fn row(&self, what: String, (seconds, ceiling): (f64, f64), flops: u64, bytes: u64) -> Row {
        let (width, executor, budget) = (self.model.layout.features(), name(self.engine), self.engine.budget());
        Row { what, width, executor, seconds, flops, of_sgemm: flops as f64 / seconds / ceiling, bytes, budget }
    }

    fn pose_step(&mut self, method: Method, hypotheses: u32, side: u32) -> Result<(Row, Descent)> {
        let pixels = side * side;
        let shape = Shape { hypotheses, width: side, height: side, instances: 1 };
        let mut descent = Descent::new(self.engine, self.model, shape, method)?;
        let target = target(3 * hypotheses * pixels);
        descent.set_targets(&[0], &vec![0; hypotheses as usize], &rays(hypotheses, side, pixels), &target, None)?;
        let poses = camera::fixed24(1.3).iter().cycle().take(hypotheses as usize).map(Pose6::from_matrix).collect::<Vec<_>>();
        descent.set_poses(&poses)?;
        let time = self.measure(|| {
            descent.evaluate()?;
            descent.descend()?;
            descent.losses()?;
            Ok(())
        })?;
        let name = if matches!(method, Method::Adam { .. }) { "Adam" } else { "BFGS" };
        let what = format!("pose step, {name}, {hypotheses} hypotheses");
        Ok((self.row(what, time, descent.flops_per_step(), descent.bytes()), descent))
    }

    /// What the search for a pose finds cooperative matrices to change in gradients, before it decides on them.
    fn cooperative_difference(&self) -> Result<f64> {
        let (starts, rgb) = (camera::fixed24(1.3)[..8].to_vec(), target(3 * RAYS));
        let query = Query { instance: 0, intrinsics: intrinsics(SIDE), width: SIDE, height: SIDE, rgb, weights: None, starts };
        let phases = vec![Phase { steps: 0, stride: 4, keep: 1 }];
        estimate(self.engine, self.model, &[query], &Options { phases, min_starts: 0, ..Options::default() }, |_| Ok(()))?;
        Ok(self.engine.cooperative_difference().unwrap_or(f64::NAN))
    }

    fn training_step(&mut self) -> Result<Row> {
        const IMAGES: u32 = 10;
        let mut trainer = Trainer::new(self.engine, self.model.clone(), Train::Everything, IMAGES, RAYS)?;
        let instances = (0..IMAGES).map(|image| image % 9).collect();
        let batch = TrainingBatch { instances, rays: rays(IMAGES, SIDE, RAYS), target_rgb: target(3 * IMAGES * RAYS) };
        let time = self.measure(|| {
            trainer.step(&batch, 1e-4)?;
            trainer.losses()?;
            Ok(())
        })?;
        let plan = trainer.executor().plan();
        let flops = plan.stages.iter().flat_map(|stage| &stage.steps).map(|step| step.flops).sum();
        let bytes = plan.bytes();
        Ok(self.row("training step, 10 images".into(), time, flops, bytes))
    }

    fn picture(&mut self) -> Result<Row> {
        let mut renderer = Renderer::new(self.engine, self.model, 1, SIDE, SIDE)?;
        let cameras = [(camera::fixed24(1.3)[3], intrinsics(SIDE))];
        let time = self.measure(|| {
            renderer.render(&[0], &cameras, 0)?;
            Ok(())
        })?;
        // A fifth of a pose step is one picture forward and backward; only its time is reported.
        Ok(self.row("picture".into(), time, 0, 0))
    }
}

/// Time of each kernel: from the device's clock on a GPU, from ours on the CPU.
fn profile(descent: &mut Descent, width: u32, executor: &'static str) -> Result<Vec<KernelRow>> {
    let row = |(label, (steps, seconds, flops))| KernelRow { width, executor, label, steps, seconds, flops };
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
    let mut cells = vec![row.what.clone(), row.width.to_string(), row.executor.into(), seconds];
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

fn report(hardware: &str, ceiling: f64, rows: &[Row], scaling: &[Scaling], kernels: &[KernelRow]) -> String {
    let mut text = format!("{hardware}. `cargo xtask bench`\n\n");
    text +=
        &format!("Matrix library (`gemm`, 1536 × 1536 × 1536, all threads) in the same run: {:.0} GFLOP/s.\n\n", ceiling / 1e9);
    text += "| work, 64 × 64 pixels | width | executor | median time | GFLOP | GFLOP/s | of sgemm | plan of budget |\n";
    text += "|---|---|---|---|---|---|---|---|\n";
    rows.iter().for_each(|row| text += &format!("{}\n", line(row)));
    if !scaling.is_empty() {
        text += "\nCost against work, a pose step of Adam at width 64:\n\n";
        text += "| executor | hypotheses | side | rays | median time | µs a ray |\n|---|---|---|---|---|---|\n";
    }
    for row in scaling {
        let Scaling { executor, hypotheses, side, seconds } = row;
        let (rays, each) = (row.rays(), 1e6 * seconds / f64::from(row.rays()));
        text += &format!("| {executor} | {hypotheses} | {side} | {rays} | {:.1} ms | {each:.2} |\n", 1e3 * seconds);
    }
    text += "\nKernels of a pose step of Adam, each timed alone:\n\n| width | executor | kernel | steps | ms | GFLOP/s |\n|---|---|---|---|---|---|\n";
    for of_one in kernels.chunk_by(|a, b| (a.width, a.executor) == (b.width, b.executor)) {
        for KernelRow { width, executor, label, steps, seconds, flops } in of_one.iter().take(8) {
            let rate = if *flops == 0 { String::new() } else { format!("{:.1}", *flops as f64 / seconds / 1e9) };
            text += &format!("| {width} | {executor} | `{label}` | {steps} | {:.1} | {rate} |\n", 1e3 * seconds);
        }
    }
    text
}

/// The same steps in PyTorch, and how many times faster ours are.
fn against_pytorch(ran_on: &str, peers: &[PeerRow], rows: &[Row]) -> String {
    if peers.is_empty() {
        return String::new();
    }
    let mut text = format!(
        "\nThe same steps in PyTorch (`bench/peer.py`), in the same run: {ran_on}. `as released`: f is evaluated again for the sum, as in the authors' code; `kept`: it is not.\n\n"
    );
    text += "| work | width | PyTorch on | version | PyTorch | ours, cpu | faster | ours, gpu | faster |\n|---|---|---|---|---|---|---|---|---|\n";
    for peer in peers {
        let ours = |executor: &str| {
            let is_it = |row: &&Row| row.width == peer.width && row.executor == executor && row.what.starts_with(&peer.work);
            // The first of a kind: Adam, and the default budget.
            let seconds = rows.iter().find(is_it).map(|row| row.seconds);
            seconds.map_or(" | ".into(), |seconds| format!("{seconds:.3} s | {:.2}", peer.seconds / seconds))
        };
        let PeerRow { work, width, version, seconds, device } = peer;
        text += &format!("| {work} | {width} | {device} | {version} | {seconds:.3} s | {} | {} |\n", ours("cpu"), ours("gpu"));
    }
    text
}

fn as_json(
    hardware: &str,
    ceiling: f64,
    rows: &[Row],
    scaling: &[Scaling],
    kernels: &[KernelRow],
    peers: &[PeerRow],
) -> serde_json::Value {
    let scaling: Vec<_> = scaling
        .iter()
        .map(|row| {
            serde_json::json!({
                "executor": row.executor, "hypotheses": row.hypotheses, "side": row.side, "rays": row.rays(), "seconds": row.seconds,
            })
        })
        .collect();
    let rows: Vec<_> = rows
        .iter()
        .map(|row| {
            serde_json::json!({
                "work": row.what, "width": row.width, "executor": row.executor, "seconds": row.seconds, "flops": row.flops,
                "of_sgemm": row.of_sgemm, "bytes": row.bytes, "budget": row.budget,
            })
        })
        .collect();
    let kernels: Vec<_> = kernels
        .iter()
        .map(|kernel| {
            serde_json::json!({
                "width": kernel.width, "executor": kernel.executor, "kernel": kernel.label, "steps": kernel.steps, "seconds": kernel.seconds,
                "flops": kernel.flops,
            })
        })
        .collect();
    serde_json::json!({ "hardware": hardware, "sgemm_flops_per_second": ceiling, "rows": rows, "scaling": scaling, "kernels": kernels, "pytorch": peers })
}
