//! Coordinators as processes: started, killed, started again at the same address.

use std::fs::File;
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use engine::{Error, ErrorKind, Result};

/// Time for a coordinator to listen.
const PATIENCE: Duration = Duration::from_secs(60);
/// Bytes of a log that are shown when its process does not start.
const SHOWN_BYTES: usize = 2_000;

/// How a coordinator is started. `--data`, `--storage`, `--database`, `--lease` and `--listen` are added.
#[derive(Clone, Debug)]
pub struct Launch {
    /// The program.
    pub program: PathBuf,
    /// Its first arguments.
    pub arguments: Vec<String>,
}

/// What one coordinator is started with.
#[derive(Clone, Debug)]
pub struct Setup {
    /// Its own folder.
    pub data: PathBuf,
    /// The objects' folder, which all share.
    pub storage: PathBuf,
    /// The database.
    pub database: String,
    /// Seconds that leases last.
    pub lease_s: u32,
    /// Variables of its environment.
    pub environment: Vec<(String, String)>,
}

/// A coordinator's process; it ends with this value.
#[derive(Debug)]
pub struct Process {
    child: Child,
    /// Where it listens.
    pub listen: SocketAddr,
    /// What it says.
    pub log: PathBuf,
}

/// A port of the loopback interface that nobody listens at.
pub fn free_port() -> Result<SocketAddr> {
    let listener = TcpListener::bind("127.0.0.1:0").and_then(|listener| listener.local_addr());
    listener.map_err(|error| Error::new(ErrorKind::Io, "no port can be had").caused_by(error))
}

impl Process {
    /// Starts a coordinator and waits until it listens.
    ///
    /// # Errors
    /// When it ends before it listens; what it said is in the message.
    pub fn start(launch: &Launch, setup: &Setup, listen: SocketAddr) -> Result<Self> {
        std::fs::create_dir_all(&setup.data)
            .map_err(|error| Error::io("create the folder", &setup.data, error))?;
        let log = setup.data.join("log");
        let file = File::options().create(true).append(true).open(&log);
        let file = file.map_err(|error| Error::io("open", &log, error))?;
        let mut command = Command::new(&launch.program);
        command.args(&launch.arguments).arg("--data").arg(&setup.data).arg("--storage").arg(&setup.storage);
        command.args(["--database", &setup.database, "--lease", &setup.lease_s.to_string()]);
        command.args(["--listen", &listen.to_string()]);
        command.envs(setup.environment.iter().map(|(name, value)| (name, value)));
        command.stdin(Stdio::null()).stdout(Stdio::null()).stderr(file);
        let child =
            command.spawn().map_err(|error| Error::io("start the program", &launch.program, error))?;
        let mut process = Self { child, listen, log };
        process.wait_until_it_listens()?;
        Ok(process)
    }

    fn wait_until_it_listens(&mut self) -> Result<()> {
        let start = Instant::now();
        while std::net::TcpStream::connect(self.listen).is_err() {
            if !self.is_running() || start.elapsed() > PATIENCE {
                let said = said(&self.log);
                return Err(Error::new(ErrorKind::Io, format!("the coordinator does not start: {said}")));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        Ok(())
    }

    /// The URL of its operations.
    pub fn url(&self) -> String {
        format!("http://{}", self.listen)
    }

    /// Whether it has not ended.
    pub fn is_running(&mut self) -> bool {
        matches!(self.child.try_wait(), Ok(None))
    }

    /// The process's id.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Kills it: nothing is flushed, nobody is told.
    pub fn kill(&mut self) {
        // It may have ended already
        let _ = self.child.kill();
        let _ = self.child.wait();
    }

    /// Bytes of memory that are resident; none where the system does not say.
    pub fn resident_bytes(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
        let kilobytes: u64 = line.trim().trim_end_matches("kB").trim().parse().ok()?;
        Some(kilobytes << 10)
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
    }
}

/// The end of a log.
fn said(log: &Path) -> String {
    let text = std::fs::read(log).unwrap_or_default();
    let end = &text[text.len().saturating_sub(SHOWN_BYTES)..];
    String::from_utf8_lossy(end).trim().to_owned()
}
