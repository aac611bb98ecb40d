//! Whatever viewers do, the run goes on, and memory is bounded.

mod common;

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Mutex;
use std::time::Duration;

use common::{MIB, frame, head_of, memory};
use realo_view::{Foxglove, Session};
use serde_json::{Value, json};

/// Tests that measure this process's memory, or use all connections, run one after the other.
static ALONE: Mutex<()> = Mutex::new(());

fn server() -> Foxglove {
    Foxglove::start(SocketAddr::from(([127, 0, 0, 1], 0))).expect("a free port")
}

fn asks(server: &Foxglove, more: &str) -> (TcpStream, String) {
    let mut stream = TcpStream::connect(server.address()).expect("it listens");
    stream
        .set_read_timeout(Some(Duration::from_secs(30)))
        .expect("a socket");
    let request = format!(
        "GET /?x=1 HTTP/1.1\r\nHost: {}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n\
         Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{more}\r\n",
        server.address()
    );
    stream.write_all(request.as_bytes()).expect("it listens");
    let head = head_of(&mut stream);
    (stream, head)
}

/// A viewer after the handshake.
fn looking(server: &Foxglove) -> TcpStream {
    let (stream, head) = asks(server, "Sec-WebSocket-Protocol: x, foxglove.sdk.v1\r\n");
    assert!(
        head.starts_with("HTTP/1.1 101 ") && head.contains("Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n"),
        "{head}"
    );
    stream
}

fn say(stream: &mut TcpStream, said: &str) -> bool {
    let mut frame = vec![0x81, 0x80 | 126];
    frame.extend((said.len() as u16).to_be_bytes());
    frame.extend([0; 4]);
    frame.extend(said.as_bytes());
    stream.write_all(&frame).is_ok()
}

/// The next text.
fn text(stream: &mut TcpStream) -> Value {
    loop {
        match frame(stream) {
            (1, text) => return serde_json::from_slice(&text).expect("JSON"),
            (9, _) => {}
            (kind, content) => panic!("kind {kind}: {content:?}"),
        }
    }
}

/// The next bytes.
fn bytes(stream: &mut TcpStream) -> Vec<u8> {
    loop {
        match frame(stream) {
            (2, bytes) => return bytes,
            (9, _) => {}
            (kind, content) => panic!("kind {kind}: {content:?}"),
        }
    }
}

/// A run with a channel.
fn opened(server: &Foxglove) -> (Session, u32) {
    let session = server.open("a run");
    let channel = session
        .channel("/cav1/note", "std_msgs/msg/String", "string data\n")
        .expect("there is room");
    (session, channel)
}

/// Asks for a channel after the run was announced.
fn subscribe(stream: &mut TcpStream, channel: u32) {
    while text(stream)["op"] != "advertise" {}
    let asked = json!({ "op": "subscribe", "subscriptions": [{ "id": 70, "channelId": channel }] });
    assert!(say(stream, &asked.to_string()));
}

#[test]
fn a_viewer_is_told_of_channels_and_gets_those_that_it_asks_for() {
    let _alone = ALONE.lock();
    let server = server();
    let mut viewer = looking(&server);
    assert_eq!(text(&mut viewer)["op"], "serverInfo");
    let (session, channel) = opened(&server);
    let info = text(&mut viewer);
    assert_eq!(
        (&info["op"], &info["name"]),
        (&json!("serverInfo"), &json!("realo, a run"))
    );
    let offered = text(&mut viewer);
    assert_eq!(offered["channels"][0]["topic"], "/cav1/note");
    session.send(channel, "cav1", 5, b"before it asks".to_vec());
    let asked = json!({ "op": "subscribe", "subscriptions": [{ "id": 70, "channelId": channel }] });
    assert!(say(&mut viewer, &asked.to_string()));
    assert_eq!(bytes(&mut viewer), [2, 5, 0, 0, 0, 0, 0, 0, 0], "the time");
    let got = bytes(&mut viewer);
    assert_eq!(
        (&got[..13], &got[13..]),
        (&[1, 70, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0, 0][..], &b"before it asks"[..])
    );
    // Time does not run backwards, whatever messages say.
    session.send(channel, "cav1", 4, b"late".to_vec());
    assert_eq!(&bytes(&mut viewer)[13..], b"late");
    session.send(channel, "cav1", 6, vec![7; 300_000]);
    assert_eq!(bytes(&mut viewer)[..2], [2, 6]);
    assert_eq!(bytes(&mut viewer).len(), 300_013);
    assert!(say(&mut viewer, r#"{"op":"unsubscribe","subscriptionIds":[70]}"#));
    assert!(say(&mut viewer, r#"{"op":"getParameters","parameterNames":[]}"#));
    assert_eq!(text(&mut viewer)["level"], 1, "it is told what it may ask");
    session.send(channel, "cav1", 7, b"not asked for".to_vec());
    let next = server.open("the next run");
    session.send(channel, "cav1", 8, b"of a run that is over".to_vec());
    assert_eq!(
        text(&mut viewer),
        json!({ "op": "unadvertise", "channelIds": [channel] })
    );
    assert_eq!(text(&mut viewer)["name"], "realo, the next run");
    assert!(next.channel("/cav1/note", "std_msgs/msg/String", "string data\n") > Some(channel));
    drop(server);
    while frame(&mut viewer).0 != 8 {}
}

#[test]
fn strangers_and_junk_get_nothing() {
    let _alone = ALONE.lock();
    let server = server();
    let (session, channel) = opened(&server);
    for (more, status) in [
        (
            "Origin: http://evil.example\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n",
            "403",
        ),
        ("Origin: null\r\nSec-WebSocket-Protocol: foxglove.sdk.v1\r\n", "403"),
        ("Sec-WebSocket-Protocol: mqtt\r\n", "400"),
        ("", "400"),
    ] {
        let (_, head) = asks(&server, more);
        assert!(head.starts_with(&format!("HTTP/1.1 {status} ")), "{more}: {head}");
    }
    let said = |request: &[u8]| {
        let mut stream = TcpStream::connect(server.address()).expect("it listens");
        let _ = stream.write_all(request);
        let mut answer = Vec::new();
        let _ = stream.read_to_end(&mut answer);
        String::from_utf8_lossy(&answer).into_owned()
    };
    let page = said(format!("GET / HTTP/1.1\r\nHost: {}\r\n\r\n", server.address()).as_bytes());
    assert!(
        page.starts_with("HTTP/1.1 426 ") && page.contains("Foxglove or Lichtblick"),
        "{page}"
    );
    assert!(said(b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n").starts_with("HTTP/1.1 403 "));
    assert_eq!(said(&vec![b'x'; 4 * MIB]), "", "a head without an end");
    for (what, frame) in [
        ("longer than a text may be", vec![0x81, 0xff, 0, 0, 0, 0, 1, 0, 0, 0]),
        ("not masked", vec![0x81, 1, b'x']),
        ("not a text", vec![0x81, 0x81, 0, 0, 0, 0, 0xff]),
        ("no frame", vec![0xff; 64]),
    ] {
        let mut talker = looking(&server);
        let _ = talker.write_all(&frame);
        let mut rest = Vec::new();
        let _ = talker.read_to_end(&mut rest);
        assert!(rest.len() < MIB, "{what}: it is shut out");
    }
    let mut viewer = looking(&server);
    subscribe(&mut viewer, channel);
    session.send(channel, "cav1", 1, b"still there".to_vec());
    bytes(&mut viewer);
    assert_eq!(&bytes(&mut viewer)[13..], b"still there");
}

#[test]
fn viewers_that_stopped_reading_hold_up_nothing_and_memory_is_bounded() {
    let _alone = ALONE.lock();
    let server = server();
    let (session, channel) = opened(&server);
    let mut asleep: Vec<TcpStream> = (0..20).map(|_| looking(&server)).collect();
    asleep.iter_mut().for_each(|stream| subscribe(stream, channel));
    let before = memory();
    // 4 GB, if somebody kept them.
    for time in 0..4096 {
        session.send(channel, "cav1", time, vec![1; MIB]);
    }
    let after = memory();
    assert!(after < before + 200 * MIB, "from {before} to {after} bytes");
    let mut awake = looking(&server);
    subscribe(&mut awake, channel);
    bytes(&mut awake);
    assert_eq!(bytes(&mut awake).len(), MIB + 13, "the newest");
    drop(asleep);
}

#[test]
fn a_viewer_that_asks_a_hundred_thousand_times_is_answered_a_bounded_number_of_times() {
    let _alone = ALONE.lock();
    let server = server();
    let (session, channel) = opened(&server);
    let before = memory();
    let mut talker = looking(&server);
    let mut other = looking(&server);
    let asks = json!({ "op": "subscribe", "subscriptions": [{ "id": 1, "channelId": channel }] }).to_string();
    // It does not read what it is told.
    for at in 0..100_000 {
        let said = match at % 4 {
            0 => asks.as_str(),
            1 => "{}",
            2 => r#"{"op":"unsubscribe","subscriptionIds":[1]}"#,
            _ => "junk",
        };
        if !say(&mut talker, said) {
            break;
        }
    }
    assert!(memory() < before + 100 * MIB);
    subscribe(&mut other, channel);
    session.send(channel, "cav1", 3, b"to who is polite".to_vec());
    bytes(&mut other);
    assert_eq!(&bytes(&mut other)[13..], b"to who is polite");
}

#[test]
fn a_port_that_is_taken_is_a_clear_error() {
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let at = taken.local_addr().expect("it has an address");
    let error = Foxglove::start(at).err().expect("it is taken").to_string();
    assert!(
        error.contains(&at.to_string()) && error.contains("choose another port"),
        "{error}"
    );
}
