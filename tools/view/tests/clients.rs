//! Whatever clients do, what is shown goes on, and memory is bounded.

mod common;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Mutex;
use std::time::Duration;

use common::{MIB, frame, head_of, memory};
use realo_view::Server;

/// Tests that measure this process's memory, or use all connections, run one after the other.
static ALONE: Mutex<()> = Mutex::new(());

fn server() -> Server {
    Server::start(SocketAddr::from(([127, 0, 0, 1], 0)), |host| {
        format!("<p>page for {host}</p>")
    })
    .expect("a free port")
}

fn connect(server: &Server) -> TcpStream {
    let stream = TcpStream::connect(server.address()).expect("it listens");
    stream
        .set_read_timeout(Some(Duration::from_secs(30)))
        .expect("a socket");
    stream
}

fn said(server: &Server, request: &[u8]) -> String {
    let mut stream = connect(server);
    // It may have answered and gone before all is sent.
    let _ = stream.write_all(request);
    let mut bytes = Vec::new();
    let _ = stream.read_to_end(&mut bytes);
    String::from_utf8_lossy(&bytes).into_owned()
}

fn upgrade(server: &Server, origin: &str) -> String {
    format!(
        "GET /pictures HTTP/1.1\r\nHost: {}\r\nOrigin: {origin}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n",
        server.address()
    )
}

/// A client of the page, after the handshake.
fn looking(server: &Server) -> TcpStream {
    let mut stream = connect(server);
    let request = upgrade(server, &format!("http://{}", server.address()));
    stream.write_all(request.as_bytes()).expect("it listens");
    let head = head_of(&mut stream);
    assert!(
        head.starts_with("HTTP/1.1 101 ") && head.contains("s3pPLMBiTxaQ9kYGzzhZRbK+xOo="),
        "{head}"
    );
    stream
}

/// The next frame that shows something.
fn shown(stream: &mut TcpStream) -> Vec<u8> {
    loop {
        match frame(stream) {
            (1 | 2, content) => return content,
            (9, _) => {}
            (kind, content) => panic!("kind {kind}: {content:?}"),
        }
    }
}

#[test]
fn a_page_gets_the_scene_and_all_pictures_in_order() {
    let _alone = ALONE.lock();
    let server = server();
    let page = said(
        &server,
        format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", server.address()).as_bytes(),
    );
    assert!(
        page.starts_with("HTTP/1.1 200 ") && page.ends_with(&format!("<p>page for {}</p>", server.address())),
        "{page}"
    );
    let mut early = looking(&server);
    server.open("a scene");
    server.picture(vec![1; 100_000]);
    server.say("words");
    let mut late = looking(&server);
    for stream in [&mut early, &mut late] {
        assert_eq!(shown(stream), b"a scene");
        assert_eq!(shown(stream), vec![1; 100_000]);
        assert_eq!(shown(stream), b"words");
    }
    // A masked ping gets a pong with the same content.
    early
        .write_all(&[0x89, 0x82, 1, 2, 3, 4, b'h' ^ 1, b'i' ^ 2])
        .expect("it listens");
    while frame(&mut early) != (10, b"hi".to_vec()) {}
    drop(server);
    while frame(&mut late).0 != 8 {}
}

#[test]
fn strangers_and_junk_get_nothing() {
    let _alone = ALONE.lock();
    let server = server();
    server.open("a secret scene");
    for origin in ["http://evil.example", "null", "http://127.0.0.1:1"] {
        let answer = said(&server, upgrade(&server, origin).as_bytes());
        assert!(
            answer.starts_with("HTTP/1.1 403 ") && !answer.contains("secret"),
            "{answer}"
        );
    }
    let rebound = said(&server, b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n");
    assert!(rebound.starts_with("HTTP/1.1 403 "), "{rebound}");
    assert!(said(&server, b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n").starts_with("HTTP/1.1 405 "));
    assert!(said(&server, b"GET /etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n").starts_with("HTTP/1.1 404 "));
    assert_eq!(said(&server, &vec![b'x'; 4 * MIB]), "", "a head without an end");
    assert_eq!(said(&server, b"\xff\xfe\r\n\r\n"), "", "not a text");
    assert!(said(&server, b"junk\r\n\r\n").starts_with("HTTP/1.1 400 "));
    // A client that shows pictures itself is shut out.
    let mut talker = looking(&server);
    let _ = talker.write_all(&[0x82, 0xfe, 0xff, 0xff, 0, 0, 0, 0]);
    let _ = talker.write_all(&vec![7; MIB]);
    let mut rest = Vec::new();
    let _ = talker.read_to_end(&mut rest);
    assert!(rest.len() < MIB);
    assert_eq!(
        shown(&mut looking(&server)),
        b"a secret scene",
        "the own page is served all the while"
    );
}

#[test]
fn browsers_that_stopped_reading_hold_up_nothing_and_memory_is_bounded() {
    let _alone = ALONE.lock();
    let server = server();
    server.open("a scene");
    let asleep: Vec<TcpStream> = (0..20).map(|_| looking(&server)).collect();
    let before = memory();
    // 4 GB, if somebody kept them.
    for _ in 0..4096 {
        server.picture(vec![1; MIB]);
    }
    let after = memory();
    assert!(after < before + 200 * MIB, "from {before} to {after} bytes");
    let mut awake = looking(&server);
    assert_eq!(shown(&mut awake), b"a scene");
    assert_eq!(shown(&mut awake).len(), MIB);
    drop(asleep);
}

#[test]
fn more_connections_than_there_are_places_are_turned_away_and_come_in_later() {
    let _alone = ALONE.lock();
    let server = server();
    server.open("a scene");
    let looking: Vec<TcpStream> = (0..32).map(|_| looking(&server)).collect();
    let page = format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", server.address());
    let mut answer = said(&server, page.as_bytes());
    // Its head may be lost where the server is gone before the request has come.
    assert!(answer.is_empty() || answer.starts_with("HTTP/1.1 503 "), "{answer}");
    drop(looking);
    while !answer.starts_with("HTTP/1.1 200 ") {
        server.say("so that the server sees who is gone");
        std::thread::sleep(Duration::from_millis(20));
        answer = said(&server, page.as_bytes());
    }
}

#[test]
fn who_connects_again_and_again_finds_a_server_that_goes_on() {
    let _alone = ALONE.lock();
    let server = server();
    server.open("a scene");
    let before = memory();
    let address = server.address();
    let hammers: Vec<_> = (0..4)
        .map(|_| {
            std::thread::spawn(move || {
                for _ in 0..200 {
                    if let Ok(mut stream) = TcpStream::connect(address) {
                        let _ = stream.write_all(b"GET / HTTP/1.1\r\n");
                    }
                }
            })
        })
        .collect();
    for _ in 0..1000 {
        server.picture(vec![1; 1000]);
    }
    hammers.into_iter().for_each(|hammer| hammer.join().expect("it ends"));
    assert!(memory() < before + 100 * MIB);
    let mut stream = looking(&server);
    assert_eq!(shown(&mut stream), b"a scene");
}

#[test]
fn a_port_that_is_taken_is_a_clear_error() {
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let at = taken.local_addr().expect("it has an address");
    let error = Server::start(at, |_| String::new())
        .err()
        .expect("it is taken")
        .to_string();
    assert!(
        error.contains(&at.to_string()) && error.contains("choose another port"),
        "{error}"
    );
}
