//! `realo run --view`: a browser sees the run while it goes on, the run does not know of it, and nobody else is answered.

#[path = "common/browser.rs"]
mod browser;
mod common;

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};

use browser::Browser;
use common::watched::{PATIENCE, Watched, options};
use common::{assert_same_files, folder, free_port, realo, text};
use serde_json::Value;

/// A page as this test plays it.
struct Page(TcpStream);

impl Page {
    fn open(host: &str) -> Self {
        let mut stream = TcpStream::connect(host).expect("it listens");
        stream.set_read_timeout(Some(PATIENCE)).expect("a socket");
        let request = format!(
            "GET /pictures HTTP/1.1\r\nHost: {host}\r\nOrigin: http://{host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n"
        );
        stream.write_all(request.as_bytes()).expect("it listens");
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).expect("it answers");
            head.push(byte[0]);
        }
        assert!(head.starts_with(b"HTTP/1.1 101 "), "{}", text(&head));
        Page(stream)
    }

    fn bytes<const N: usize>(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        self.0.read_exact(&mut bytes).ok().map(|()| bytes)
    }

    /// The next frame: its kind and content; `None` at the end.
    fn frame(&mut self) -> Option<(u8, Vec<u8>)> {
        let [kind, length] = self.bytes()?;
        let length = match length {
            126 => usize::from(u16::from_be_bytes(self.bytes()?)),
            127 => u64::from_be_bytes(self.bytes()?) as usize,
            short => usize::from(short),
        };
        let mut content = vec![0; length];
        self.0.read_exact(&mut content).ok()?;
        Some((kind & 0x0f, content))
    }

    /// The next picture's text and the number of its points; texts that come before go to `said`.
    fn picture(&mut self, said: &mut Vec<Value>) -> Option<(Value, usize)> {
        loop {
            match self.frame()? {
                (1, content) => said.push(serde_json::from_slice(&content).expect("JSON")),
                (2, content) => {
                    let (length, rest) = content.split_first_chunk::<4>().expect("a length");
                    let (head, points) = rest.split_at(u32::from_le_bytes(*length) as usize);
                    return Some((serde_json::from_slice(head).expect("JSON"), points.len() / 6));
                }
                (8, _) => return None,
                _ => {}
            }
        }
    }
}

#[test]
fn a_run_in_virtual_time_is_the_same_to_the_bit_when_it_is_watched() {
    let (watched, alone) = (folder("view_watched"), folder("view_alone"));
    let link = ["--mode", "virtual", "--link", "delay_ms=60,loss=0.2"];
    let said = realo(options(
        "late_fusion",
        &watched,
        &[&link[..], &["--view", "--view-exit"]].concat(),
    ));
    assert_eq!(said.status.code(), Some(0), "{}", text(&said.stderr));
    let said = realo(options("late_fusion", &alone, &link));
    assert_eq!(said.status.code(), Some(0), "{}", text(&said.stderr));
    let files = [
        "result.json",
        "view_small/cav1/result.json",
        "view_small/cav1/evaluation.json",
    ];
    assert_same_files(&watched, &alone, &files);
}

#[test]
fn pictures_of_a_run_on_dora_have_boxes_truth_points_and_what_was_fused() {
    let out = folder("view_realtime");
    let watched = Watched::start(options("late_fusion", &out, &["--view"]), "http://");
    let mut page = Page::open(&watched.host);
    let (mut said, mut pictures) = (Vec::new(), Vec::new());
    // A busy machine skips sweeps; some come.
    while pictures.len() < 3 {
        pictures.push(page.picture(&mut said).expect("pictures come"));
    }
    watched.until("the last run stays at");
    assert_eq!(said[0]["what"], "scene");
    assert_eq!(said[0]["scene"]["ego"], "cav1");
    let mut late = Page::open(&watched.host);
    // On a busy machine some sweeps are drawn before their truth, or the sweeps and states of others, have come.
    loop {
        let (head, points) = late.picture(&mut said).expect("who comes late gets a whole one");
        let count = |of: &Value| of.as_array().map_or(0, Vec::len);
        let of_sweep = head["run"]["boxes"].is_array() && head["run"]["known"] == true;
        if of_sweep && count(&head["clouds"]) > 0 && points > 100 && count(&head["agents"]) > 1 {
            break;
        }
    }
    while !said.iter().any(|said| said["what"] == "used") {
        late.picture(&mut said).expect("what was fused is said");
    }
    assert_eq!(watched.close(), Some(0), "the run had come to its end");
    while late.frame().is_some() {}
}

#[test]
fn a_browser_shows_the_newest_sweep_and_plays_those_before() {
    let home = folder("view_browser");
    let Some(mut browser) = Browser::start(&home.join("profile")) else {
        return;
    };
    let options = options("late_fusion", &home.join("out"), &["--mode", "virtual", "--view"]);
    let watched = Watched::start(options, "http://");
    browser.visit(&format!("http://{}/", watched.host), [1280, 900]);
    watched.until("the last run stays at");
    browser.wait("live.pictures > 3 && panes.length === 1");
    assert_eq!(browser.value("state.at === timeline().length - 1"), true, "the newest");
    assert_eq!(
        browser.value("live.points > 100 && decoded.size > 0"),
        true,
        "points are drawn"
    );
    assert_eq!(
        browser.value("panes[0].shown.some(({ one }) => one.kind === 'box')"),
        true
    );
    let title = browser.value("byId('title').textContent");
    assert_eq!(title, "late_fusion, view_small, cav1");
    browser.press("ArrowLeft");
    browser.press("ArrowLeft");
    assert_eq!(
        browser.value("[live.shows, timeline().length - 1 - state.at]"),
        serde_json::json!([false, 2])
    );
    browser.press("End");
    assert_eq!(browser.value("live.shows && state.at === timeline().length - 1"), true);
    browser.value("state.speed = 10; seek(0); play(true)");
    browser.wait("live.shows && !state.playing");
    browser.press("3");
    assert_eq!(browser.value("state.view"), "3d");
    assert!(browser.picture().len() > 10_000);
    let sideways = "document.documentElement.scrollWidth <= innerWidth";
    assert_eq!(browser.value(sideways), true, "the page scrolls sideways");
    assert_eq!(browser.said, [""; 0], "the console of the page");
    assert_eq!(watched.close(), Some(0));
    browser.wait("!live.reached");
    assert!(browser.value("byId('what').textContent").to_string().contains("closed"));
    assert_eq!(browser.value("panes[0].shown.length > 0"), true, "what came stays");
}

#[test]
fn a_port_that_is_taken_and_an_address_that_is_none_are_errors_before_the_run() {
    let out = folder("view_errors").join("out");
    let taken = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let at = taken.local_addr().expect("it has an address");
    let said = realo(options(
        "late_fusion",
        &out,
        &["--mode", "virtual", "--view", &at.port().to_string()],
    ));
    let words = text(&said.stderr);
    assert_eq!(said.status.code(), Some(1), "{words}");
    assert!(
        words.contains(&at.to_string()) && words.contains("choose another port"),
        "{words}"
    );
    let said = realo(options("late_fusion", &out, &["--view", "somewhere"]));
    let words = text(&said.stderr);
    assert_eq!(said.status.code(), Some(2), "{words}");
    assert!(words.contains("IP:PORT") && words.contains("`somewhere`"), "{words}");
    let both = free_port().to_string();
    let said = realo(options("late_fusion", &out, &["--view", &both, "--foxglove", &both]));
    let words = text(&said.stderr);
    assert_eq!(said.status.code(), Some(1), "{words}");
    assert!(
        words.contains("expected two addresses") && words.contains(&both),
        "{words}"
    );
    assert!(!out.exists(), "nothing was run");
    let said = realo(options("late_fusion", &out, &["--view-exit"]));
    assert_eq!(said.status.code(), Some(2), "{}", text(&said.stderr));
}

#[test]
fn clients_that_send_junk_or_stop_reading_do_not_disturb_a_run() {
    let out = folder("view_hostile");
    let port = free_port().to_string();
    let watched = Watched::start(
        options("late_fusion", &out, &["--view", &port, "--view-exit"]),
        "http://",
    );
    assert_eq!(watched.host, format!("127.0.0.1:{port}"));
    let host = watched.host.clone();
    let asleep: Vec<Page> = (0..8).map(|_| Page::open(&host)).collect();
    let hammer = std::thread::spawn(move || {
        let mut times = 0;
        while let Ok(mut stream) = TcpStream::connect(&host) {
            let junk: [&[u8]; 3] = [
                b"GET / HTTP/1.1\r\nHost: evil\r\n\r\n",
                b"\x00\xff\r\n\r\n",
                &[b'x'; 20_000],
            ];
            let _ = stream.write_all(junk[times % 3]);
            times += 1;
        }
        times
    });
    let mut watched = watched;
    let code = watched.process.wait().expect("it was started").code();
    let said: Vec<String> = watched.lines.try_iter().collect();
    assert_eq!(code, Some(0), "{said:#?}");
    assert!(hammer.join().expect("it ends with the server") > 0);
    let result = common::json(&out.join("result.json"));
    assert!(result["frames"]["processed"].as_u64() > Some(0));
    drop(asleep);
}
