//! The peer of the benchmark: the same steps in PyTorch (`bench/peer.py`), where there is one.

use std::path::Path;
use std::process::{Command, Stdio};

/// Time of a step in PyTorch.
#[derive(Clone, Debug, serde::Serialize, serde::Deserialize)]
pub struct PeerRow {
    /// `pose step` or `training step`.
    pub work: String,
    /// Features of the networks.
    pub width: u32,
    /// `as released`: f evaluated again for the sum; `kept`: once.
    pub version: String,
    /// Median.
    pub seconds: f64,
    /// `cpu` or `cuda`.
    #[serde(default)]
    pub device: String,
}

#[derive(serde::Deserialize)]
struct Answer {
    torch: String,
    device: String,
    threads: u32,
    rows: Vec<PeerRow>,
}

/// PyTorch on this machine.
pub struct Peer {
    python: String,
    devices: Vec<&'static str>,
}

impl Peer {
    /// The interpreter that `PYTHON` names, else `python3`; `None` where that has no PyTorch.
    pub fn find() -> Option<Self> {
        let python = std::env::var("PYTHON").unwrap_or("python3".into());
        let code = "import torch; print(torch.cuda.is_available())";
        let output = Command::new(&python).args(["-c", code]).stderr(Stdio::null()).output().ok()?;
        let answer = String::from_utf8_lossy(&output.stdout);
        let devices = if answer.trim() == "True" { vec!["cpu", "cuda"] } else { vec!["cpu"] };
        output.status.success().then_some(Peer { python, devices })
    }

    /// Times the steps of one width on every device: what PyTorch ran on, and the rows.
    pub fn time(&self, width: u32) -> Result<(String, Vec<PeerRow>), Box<dyn std::error::Error>> {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../bench/peer.py");
        let (mut ran_on, mut all) = (Vec::new(), Vec::new());
        for &device in &self.devices {
            // A step of the paper's training takes half a minute on two cores.
            let runs = if width > 64 && device == "cpu" { "1" } else { "5" };
            let mut command = Command::new(&self.python);
            command.arg(&script).args(["time", "--json", "--width", &width.to_string(), "--device", device, "--runs", runs]);
            let output = command.stderr(Stdio::inherit()).output()?;
            if !output.status.success() {
                return Err(format!("{}: {}", script.display(), output.status).into());
            }
            let answer: Answer = serde_json::from_slice(&output.stdout)?;
            ran_on.push(format!("{} (PyTorch {}, {} threads)", answer.device, answer.torch, answer.threads));
            all.extend(answer.rows.into_iter().map(|row| PeerRow { device: device.into(), ..row }));
        }
        Ok((ran_on.join("; "), all))
    }
}
