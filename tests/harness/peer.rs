//! The peer of the benchmark: the same steps in PyTorch (`bench/peer.py`), where there is one.

use std::error::Error;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

/// What the script says first.
#[derive(serde::Deserialize)]
struct About {
    torch: String,
    device: String,
    threads: u32,
    steps: Vec<String>,
}

/// PyTorch on a device, with networks of one width.
pub struct Peer {
    /// `cpu` or `cuda`.
    pub device: &'static str,
    /// What it runs on, in words.
    pub runs_on: String,
    /// Names of its steps: `pose step` or `training step`, then a comma and `as released` (f evaluated again for the sum) or `kept` (once).
    pub steps: Vec<String>,
    process: Child,
    questions: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Peer {
    /// One for each device that PyTorch has here, or for its GPU alone, with the interpreter that `PYTHON` names, else `python3`; none where that has no
    /// PyTorch. `unread`: steps on a GPU before their losses are read.
    pub fn start(width: u32, only_gpu: bool, unread: u32) -> Result<Vec<Self>, Box<dyn Error>> {
        let python = std::env::var("PYTHON").unwrap_or("python3".into());
        let code = "import torch; print(torch.cuda.is_available())";
        let output = match Command::new(&python).args(["-c", code]).stderr(Stdio::null()).output() {
            Ok(output) if output.status.success() => output,
            _ => return Ok(Vec::new()),
        };
        let has_gpu = String::from_utf8_lossy(&output.stdout).trim() == "True";
        let devices = [("cpu", 1, !only_gpu), ("cuda", unread, has_gpu)].into_iter().filter(|&(_, _, wanted)| wanted);
        devices.map(|(device, unread, _)| Self::on(&python, device, width, unread)).collect()
    }

    fn on(python: &str, device: &'static str, width: u32, unread: u32) -> Result<Self, Box<dyn Error>> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../bench/peer.py");
        let mut command = Command::new(python);
        command.arg(script).args(["serve", "--width", &width.to_string(), "--device", device, "--unread", &unread.to_string()]);
        let mut process = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let (questions, answers) = (process.stdin.take(), process.stdout.take().expect("it is piped"));
        let (runs_on, steps) = (String::new(), Vec::new());
        let mut peer = Peer { device, runs_on, steps, process, questions, answers: BufReader::new(answers) };
        let About { torch, device, threads, steps } = serde_json::from_str(&peer.line()?)?;
        peer.runs_on = format!("{device} (PyTorch {torch}, {threads} threads)");
        peer.steps = steps;
        Ok(peer)
    }

    fn line(&mut self) -> Result<String, Box<dyn Error>> {
        let mut line = String::new();
        match self.answers.read_line(&mut line)? {
            0 => Err(format!("bench/peer.py: {}", self.process.wait()?).into()),
            _ => Ok(line),
        }
    }

    /// Takes one of its steps: seconds.
    pub fn take(&mut self, step: &str) -> Result<f64, Box<dyn Error>> {
        writeln!(self.questions.as_mut().expect("they end with the peer"), "{step}")?;
        Ok(self.line()?.trim().parse()?)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // It ends with its input.
        self.questions = None;
        let _ = self.process.wait();
    }
}
