//! A proxy before a coordinator or a storage that can refuse, dawdle, cut off or hold what passes through it.
//!
//! One request per connection, so that every request can be told from the others.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Bytes of the head of a request or an answer at most.
const HEAD_BYTES_MAX: usize = 1 << 16;
/// The longest that a request is held: the test has failed by then.
const HELD: Duration = Duration::from_secs(60);

/// What happens to a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// It is answered with 503.
    Refuse,
    /// Its answer comes in small pieces, with pauses.
    Dawdle,
    /// The connection ends after half of its body.
    CutRequest,
    /// The connection ends after half of the answer's body.
    CutAnswer,
    /// It does not get through: [`Proxy::held`] tells, and nobody answers.
    Hold,
    /// It gets through and has its effect, but the answer does not.
    HoldAnswer,
}

/// Which requests meet a fault.
#[derive(Clone, Debug)]
pub struct Rule {
    /// What the request line begins with, such as `PUT /`.
    pub begins: &'static str,
    /// What it holds.
    pub holds: &'static str,
    /// What happens.
    pub fault: Fault,
    /// How often it happens.
    pub times: Arc<AtomicU32>,
}

impl Rule {
    /// A fault for the next `times` requests.
    pub fn new(begins: &'static str, holds: &'static str, fault: Fault, times: u32) -> Self {
        Self { begins, holds, fault, times: Arc::new(AtomicU32::new(times)) }
    }

    /// Whether it has happened as often as it was to.
    pub fn is_spent(&self) -> bool {
        self.times.load(Ordering::SeqCst) == 0
    }

    /// Whether it happens to this request.
    fn takes(&self, line: &str) -> bool {
        let fits = line.starts_with(self.begins) && line.contains(self.holds);
        let less = |times: u32| times.checked_sub(1);
        fits && self.times.fetch_update(Ordering::SeqCst, Ordering::SeqCst, less).is_ok()
    }
}

/// A proxy on a port of its own.
pub struct Proxy {
    /// The port.
    pub port: u16,
    rules: Arc<Mutex<Vec<Rule>>>,
    held: Receiver<()>,
}

impl Proxy {
    /// A proxy before the loopback's port `to`, with TLS if there is a configuration for it.
    pub fn start(to: u16, tls: Option<Arc<rustls::ServerConfig>>) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let rules: Arc<Mutex<Vec<Rule>>> = Arc::default();
        let (tell, held) = channel();
        let known = rules.clone();
        std::thread::spawn(move || {
            for client in listener.incoming().flatten() {
                let (rules, tell, tls) = (known.clone(), tell.clone(), tls.clone());
                // A side that goes away ends its connection and nothing else
                std::thread::spawn(move || {
                    client.set_read_timeout(Some(HELD)).and_then(|()| match tls {
                        None => pass(client, to, &rules, &tell),
                        Some(tls) => {
                            let connection =
                                rustls::ServerConnection::new(tls).expect("a sound configuration");
                            pass(rustls::StreamOwned::new(connection, client), to, &rules, &tell)
                        }
                    })
                });
            }
        });
        Self { port, rules, held }
    }

    /// From now on these faults happen, the first that fits.
    pub fn set(&self, rules: &[Rule]) {
        *self.rules.lock().unwrap() = rules.to_vec();
    }

    /// Waits until a request is held.
    pub fn held(&self) {
        self.held.recv_timeout(HELD).expect("no request came to be held");
    }
}

/// Passes one request on, or does not.
fn pass(
    mut client: impl Read + Write,
    to: u16,
    rules: &Mutex<Vec<Rule>>,
    tell: &Sender<()>,
) -> std::io::Result<()> {
    let (head, length) = read_head(&mut client)?;
    let line = head.lines().next().unwrap_or_default().to_owned();
    let fault = rules.lock().unwrap().iter().find(|rule| rule.takes(&line)).map(|rule| rule.fault);
    let body = length.unwrap_or(0);
    if fault == Some(Fault::Hold) {
        let _ = tell.send(());
        std::thread::sleep(HELD);
        return Ok(());
    }
    if fault == Some(Fault::Refuse) {
        std::io::copy(&mut (&mut client).take(body), &mut std::io::sink())?;
        client.write_all(b"HTTP/1.1 503 Slow Down\r\ncontent-length: 0\r\nconnection: close\r\n\r\n")?;
        return client.flush();
    }

    // The request
    let mut server = TcpStream::connect(("127.0.0.1", to))?;
    server.write_all(head.as_bytes())?;
    let sent = if fault == Some(Fault::CutRequest) { body / 2 } else { body };
    std::io::copy(&mut (&mut client).take(sent), &mut server)?;
    if fault == Some(Fault::CutRequest) {
        return Ok(());
    }

    // The answer
    let (head, length) = read_head(&mut server)?;
    if fault == Some(Fault::HoldAnswer) {
        let _ = tell.send(());
        std::thread::sleep(HELD);
        return Ok(());
    }
    client.write_all(head.as_bytes())?;
    match fault {
        Some(Fault::CutAnswer) => {
            std::io::copy(&mut server.take(length.unwrap_or(0) / 2), &mut client)?;
        }
        Some(Fault::Dawdle) => {
            let mut piece = vec![0; 16 << 10];
            loop {
                let count = server.read(&mut piece)?;
                if count == 0 {
                    break;
                }
                client.write_all(&piece[..count])?;
                client.flush()?;
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        _ => {
            std::io::copy(&mut server, &mut client)?;
        }
    }
    client.flush()
}

/// The head of a request or an answer, which is to be the last on its connection, and the length of its body.
fn read_head(from: &mut impl Read) -> std::io::Result<(String, Option<u64>)> {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") {
        from.read_exact(&mut byte)?;
        head.push(byte[0]);
        if head.len() > HEAD_BYTES_MAX {
            return Err(std::io::ErrorKind::InvalidData.into());
        }
    }
    let head = String::from_utf8(head).map_err(|_| std::io::ErrorKind::InvalidData)?;
    let named = |line: &str, name: &str| line.get(..name.len()).is_some_and(|n| n.eq_ignore_ascii_case(name));
    let length = head.lines().find(|line| named(line, "content-length:"));
    let length = length.and_then(|line| line["content-length:".len()..].trim().parse().ok());
    let kept = head.trim_end().lines().filter(|line| !named(line, "connection:"));
    let mut lines: String = kept.map(|line| format!("{line}\r\n")).collect();
    lines.push_str("connection: close\r\n\r\n");
    Ok((lines, length))
}
