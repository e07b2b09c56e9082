//! An S3 server from a package registry as a process: moto, which `tests/run` installs.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Time for the server to start.
const PATIENCE: Duration = Duration::from_secs(60);

/// A server with the bucket `films`.
pub struct S3 {
    /// Its port.
    pub port: u16,
    server: Child,
}

impl S3 {
    /// A running server; none, said aloud, where it is not installed.
    pub fn start() -> Option<Self> {
        let Some(program) = program() else {
            assert!(std::env::var_os("PANTARAY_NEEDS_S3").is_none(), "`moto_server` is not there");
            eprintln!("SKIPPED: `moto_server` is not there; tests/run installs it");
            return None;
        };
        let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let mut command = Command::new(program);
        command.args(["-H", "127.0.0.1", "-p", &port.to_string()]);
        let server = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let s3 = Self { port, server };
        let start = Instant::now();
        while s3.make_bucket().is_err() {
            assert!(start.elapsed() < PATIENCE, "the S3 server does not answer");
            std::thread::sleep(Duration::from_millis(50));
        }
        Some(s3)
    }

    fn make_bucket(&self) -> std::io::Result<()> {
        let mut stream = TcpStream::connect(("127.0.0.1", self.port))?;
        stream.write_all(
            b"PUT /films HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-length: 0\r\nconnection: close\r\n\r\n",
        )?;
        let mut answer = String::new();
        stream.read_to_string(&mut answer)?;
        let is_made = answer.split(' ').nth(1) == Some("200");
        if is_made { Ok(()) } else { Err(std::io::ErrorKind::Other.into()) }
    }
}

impl Drop for S3 {
    fn drop(&mut self) {
        let _ = self.server.kill();
        let _ = self.server.wait();
    }
}

/// The server's program: beside the readers that `tests/run` installs, or on the path.
fn program() -> Option<PathBuf> {
    let beside = std::env::var_os("PANTARAY_READERS")
        .map(|python| PathBuf::from(python).with_file_name("moto_server"));
    let names = beside.into_iter().chain([PathBuf::from("moto_server")]);
    let runs = |program: &PathBuf| {
        let mut command = Command::new(program);
        command.arg("--help").stdout(Stdio::null()).stderr(Stdio::null());
        command.status().is_ok_and(|status| status.success())
    };
    names.into_iter().find(runs)
}
