//! A real PostgreSQL of the machine's own package, for tests: one server for each test program, a database for each test.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Mutex, PoisonError};

/// A server on a free port of the loopback interface, its data in a temporary folder. It ends with this value, or with
/// this process however that ends: a shell waits for the end of its standard input, and stops it.
#[derive(Debug)]
pub struct Postgres {
    guard: Child,
    port: u16,
}

impl Postgres {
    /// Starts a server, or none where PostgreSQL is not installed.
    ///
    /// # Panics
    /// When it is installed and does not start.
    pub fn start() -> Option<Self> {
        let programs = programs()?;
        let port =
            std::net::TcpListener::bind("127.0.0.1:0").and_then(|l| l.local_addr()).expect("a port").port();
        let script = include_str!("postgres.sh");
        let mut guard = Command::new("sh")
            .args(["-c", script, "postgres"])
            .arg(&programs)
            .arg(port.to_string())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::inherit())
            .spawn()
            .expect("a shell");
        let mut ready = String::new();
        let out = guard.stdout.take().expect("piped");
        std::io::BufRead::read_line(&mut std::io::BufReader::new(out), &mut ready).expect("a line");
        assert_eq!(ready.trim(), "ready", "PostgreSQL does not start");
        Some(Self { guard, port })
    }

    /// The URL of a database; `postgres` is always there.
    pub fn url(&self, database: &str) -> String {
        format!("postgres://postgres@127.0.0.1:{}/{database}", self.port)
    }

    /// Makes a database and returns its URL.
    ///
    /// # Panics
    /// When it cannot be made.
    pub fn create(&self) -> String {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("test{}", NEXT.fetch_add(1, Ordering::Relaxed));
        let made = Command::new(programs().expect("it runs").join("createdb"))
            .args(["-h", "127.0.0.1", "-U", "postgres", "-p", &self.port.to_string(), &name])
            .status();
        assert!(made.expect("createdb").success());
        self.url(&name)
    }

    /// Stops the server at once, as a crash would, and starts it again on the same data.
    ///
    /// # Panics
    /// When it does not come back.
    pub fn crash_and_restart(&mut self) {
        let input = self.guard.stdin.as_mut().expect("piped");
        std::io::Write::write_all(input, b"restart\n").expect("the shell listens");
    }
}

impl Drop for Postgres {
    fn drop(&mut self) {
        drop(self.guard.stdin.take());
        // The shell removes the data; if it fails, a temporary folder stays behind
        let _ = self.guard.wait();
    }
}

/// A URL of a new database on a server that all tests of this program share; none where PostgreSQL is not installed.
pub fn shared_database() -> Option<String> {
    static SHARED: Mutex<Option<Option<Postgres>>> = Mutex::new(None);
    let mut shared = SHARED.lock().unwrap_or_else(PoisonError::into_inner);
    shared.get_or_insert_with(Postgres::start).as_ref().map(Postgres::create)
}

/// The folder of the newest installed PostgreSQL's programs.
fn programs() -> Option<PathBuf> {
    let versions = std::fs::read_dir("/usr/lib/postgresql").into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = versions.map(|version| version.path().join("bin")).collect();
    folders.retain(|folder| folder.join("initdb").exists());
    folders.sort();
    let on_path = || {
        let path = std::env::var_os("PATH")?;
        std::env::split_paths(&path).find(|folder| Path::new(folder).join("initdb").exists())
    };
    folders.pop().or_else(on_path)
}
