//! The client against a server that follows a script.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpListener;
use std::time::Duration;

use super::*;

/// A server that gives these answers, one to each connection; what it was asked, in the end.
fn script(answers: Vec<&'static str>) -> (String, std::thread::JoinHandle<Vec<String>>) {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    let serve = move || {
        let mut asked = Vec::new();
        for answer in answers {
            let (mut stream, _) = listener.accept().unwrap();
            stream.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            let mut reader = BufReader::new(stream.try_clone().unwrap());
            let (mut head, mut length) = (String::new(), 0);
            while !head.ends_with("\r\n\r\n") {
                let mut line = String::new();
                assert!(reader.read_line(&mut line).unwrap() > 0);
                if let Some(value) = line.to_ascii_lowercase().strip_prefix("content-length:") {
                    length = value.trim().parse().unwrap();
                }
                head.push_str(&line);
            }
            let mut body = vec![0; length];
            reader.read_exact(&mut body).unwrap();
            asked.push(head + &String::from_utf8_lossy(&body));
            stream.write_all(answer.as_bytes()).unwrap();
        }
        asked
    };
    (url, std::thread::spawn(serve))
}

const BUSY: &str = "HTTP/1.1 503 Busy\r\ncontent-length: 0\r\nconnection: close\r\n\r\n";
const SEVEN: &str = "HTTP/1.1 200 OK\r\ncontent-length: 1\r\nconnection: close\r\n\r\n7";
const NOTHING: &str = "HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n";
const TORN: &str = "HTTP/1.1 200 OK\r\ncontent-length: 9\r\nconnection: close\r\n\r\nabc";
const WHOLE: &str = "HTTP/1.1 200 OK\r\ncontent-length: 9\r\nconnection: close\r\n\r\nabcdefghi";
const GONE: &str = "HTTP/1.1 410 Gone\r\ncontent-type: application/problem+json\r\nconnection: close\r\n\r\n\
    {\"type\":\"about:blank\",\"title\":\"Gone\",\"status\":410,\"code\":\"gone\",\"detail\":\"the lease is over\"}";

fn client(url: &str) -> Client {
    Client::new(url, Some("secret"), Duration::from_secs(20)).unwrap()
}

/// Catches a request that is given up, or taken for answered, when the server is only busy or the connection breaks.
#[test]
fn requests_are_repeated_until_there_is_a_definite_answer() {
    let (url, server) = script(vec![BUSY, "", SEVEN, NOTHING, GONE]);
    let client = client(&url);
    assert_eq!(client.post::<u32>("/v1/claims", &1, Duration::ZERO).unwrap(), 7);
    assert_eq!(client.get::<Option<u32>>("/v1/nothing").unwrap(), None);
    let error = client.get::<u32>("/v1/over").unwrap_err();
    assert_eq!((error.status(), error.to_string().as_str()), (Some(410), "the lease is over (410)"));
    let asked = server.join().unwrap();
    assert!(
        asked[..3]
            .iter()
            .all(|request| request.starts_with("POST /v1/claims ") && request.ends_with("\r\n\r\n1"))
    );
    assert!(asked.iter().all(|request| request.contains("Bearer secret")));
}

/// Catches a client that waits for ever.
#[test]
fn patience_ends() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    drop(listener);
    let client = client(&url).with_patience(Duration::from_millis(300));
    assert!(matches!(client.get::<u32>("/"), Err(Error::Unreachable(_))));
}

/// Catches a torn transfer that passes for the object, and a token that another host gets to see.
#[test]
fn torn_transfers_are_repeated_and_tokens_stay_at_home() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("object");
    let (url, server) = script(vec![TORN, WHOLE, NOTHING]);
    let client = client("http://127.0.0.1:1");
    let signed =
        ObjectUrl { url: format!("{url}/object?signature=x"), headers: [("x-a".into(), "b".into())].into() };
    assert_eq!(client.download(&signed, &path, 9).unwrap(), crate::digest::of_bytes(b"abcdefghi"));
    client.upload(&signed, &path).unwrap();
    let asked = server.join().unwrap();
    assert!(
        asked.iter().all(|request| !request.contains("secret") && request.contains("x-a: b")),
        "{asked:?}"
    );
    assert!(asked[2].starts_with("PUT ") && asked[2].ends_with("\r\n\r\nabcdefghi"), "{}", asked[2]);
}
