//! `realo report`: the page opens in a browser without an error, shows what the results say, and bad input gets a clear error.

#[path = "common/browser.rs"]
mod browser;
mod common;
#[path = "report/long.rs"]
mod long;

use std::fs;
use std::path::{Path, PathBuf};

use browser::Browser;
use common::{folder, json, once, realo, realo_ok, run_virtual, simulated, text};
use realo_logs::{Log, MAX_GAP, Stream, pose_track};
use realo_render::clouds::{in_ego_frame, truth};
use serde_json::Value;

const LOG: &str = "report_small";
/// A name that a careless page would run, and that a folder may have.
const NAME: &str = "<img src=x onerror=alert(1)>\"'&";

fn log() -> PathBuf {
    let args = [
        "--seed",
        "911",
        "--seconds",
        "3",
        "--key-hz",
        "5",
        "--agents",
        "cav1,rsu1",
    ];
    simulated(LOG, &args)
}

fn run(graph: &str, args: &[&str]) -> PathBuf {
    once(&format!("report_{graph}"), |_| {
        let args = [&["--recorded-detections"][..], args].concat();
        run_virtual(&format!("report_{graph}"), graph, &log(), &args);
    })
}

/// A run of late fusion over a slow link, and one of the ego alone.
fn runs() -> [PathBuf; 2] {
    let link = ["--link", "delay_ms=60,loss=0.2", "--set", "v2x.link.range_m=1000"];
    [run("late_fusion", &link), run("no_fusion", &[])]
}

fn report(runs: &[&Path], output: &Path, args: &[&str]) -> (Option<i32>, String) {
    let runs: Vec<String> = runs.iter().map(|run| run.to_string_lossy().into_owned()).collect();
    let output = output.to_string_lossy();
    let runs: Vec<&str> = runs.iter().map(String::as_str).collect();
    let said = realo([&["report"][..], &runs, &["-o", &output], args].concat());
    (
        said.status.code(),
        format!("{}{}", text(&said.stdout), text(&said.stderr)),
    )
}

fn document(page: &Path) -> Value {
    let text = fs::read_to_string(page).expect("the page is there");
    let data = text
        .split_once("<script type=\"application/json\" id=\"data\">")
        .expect("the data")
        .1;
    let data = data.split_once("</script>").expect("their end").0;
    serde_json::from_str(data).expect("the data are JSON")
}

fn copied(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("a folder can be made");
    for entry in fs::read_dir(from).expect("it can be listed").flatten() {
        match entry.path().is_dir() {
            true => copied(&entry.path(), &to.join(entry.file_name())),
            false => drop(fs::copy(entry.path(), to.join(entry.file_name())).expect("it can be copied")),
        }
    }
}

#[test]
fn the_player_has_the_boxes_that_the_results_count() {
    let page = folder("report_counts").join("report.html");
    let [late, alone] = runs();
    let (code, said) = report(&[&late, &alone], &page, &["--log", &log().to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("2 runs, 60 sweeps in the player"), "{said}");
    let document = document(&page);
    let scene = &document["scenes"][0];
    assert_eq!(document["verdict"].as_array().map(Vec::len), Some(3));
    for (number, folder) in [&late, &alone].into_iter().enumerate() {
        let result = json(&folder.join(format!("{LOG}/cav1/result.json")));
        for (place, iou) in scene["ious"].as_array().unwrap().iter().enumerate() {
            let (mut hits, mut wrong, mut objects) = (0, 0, 0);
            for (seq, frame) in scene["runs"][number]["frames"].as_object().unwrap() {
                let shared = &scene["frames"][seq];
                if shared["key"] != true {
                    continue;
                }
                for row in frame["boxes"].as_array().unwrap() {
                    let outcome = row[9 + place].as_i64().unwrap();
                    hits += i64::from(outcome >= 0);
                    wrong += i64::from(outcome == -1);
                }
                let all = frame.get("objects").unwrap_or(&shared["objects"]).as_array().unwrap();
                objects += all.iter().filter(|object| object[0][9] == 1).count() as i64;
            }
            let counts = result["accuracy"]["sorted"]["counts"].as_object().unwrap();
            let iou = iou.as_str().unwrap();
            let total = |what: &str| counts.values().map(|of| of[iou][what].as_i64().unwrap()).sum::<i64>();
            assert_eq!(
                [hits, wrong, objects],
                ["true", "false", "total"].map(total),
                "run {number}, IoU {iou}"
            );
        }
        let used: u64 = result["links"]
            .as_object()
            .map(|links| links.values().filter_map(|kinds| kinds["boxes"]["used"].as_u64()).sum())
            .unwrap_or(0);
        let fates = &document["words"]["fates"];
        let messages = scene["runs"][number]["messages"].as_array().unwrap();
        let of_page = messages
            .iter()
            .filter(|row| fates[row[3].as_u64().unwrap() as usize] == "used");
        assert_eq!(of_page.count() as u64, used, "run {number}");
    }
}

#[test]
fn what_was_sent_in_each_second_adds_up_to_what_the_results_count() {
    let page = folder("report_carried").join("report.html");
    let [late, alone] = runs();
    let (code, said) = report(&[&late, &alone], &page, &[]);
    assert_eq!(code, Some(0), "{said}");
    let runs = &document(&page)["scenes"][0]["runs"];
    let rows = runs[0]["carried"].as_array().expect("rows");
    let sum = |column: usize| {
        rows.iter()
            .map(|row| row[column].as_u64().expect("a number"))
            .sum::<u64>()
    };
    let result = json(&late.join(format!("{LOG}/cav1/result.json")));
    let of_boxes = |what: &str| -> u64 {
        let links = result["links"].as_object().expect("links");
        links.values().filter_map(|kinds| kinds["boxes"][what].as_u64()).sum()
    };
    assert_eq!([sum(2), sum(3)], [of_boxes("sent"), of_boxes("bytes")]);
    assert!(sum(3) > 0 && rows.len() >= 3, "{rows:?}");
    assert_eq!(runs[1]["carried"], serde_json::json!([]), "alone nothing is sent");
}

#[test]
fn a_browser_opens_plays_filters_and_turns_the_page_without_an_error() {
    let home = folder("report_browser");
    let Some(mut browser) = Browser::start(&home.join("profile")) else {
        return;
    };
    let named = home.join(NAME);
    let [late, alone] = runs();
    copied(&late, &named);
    let page = home.join("report.html");
    let log = log();
    let (code, said) = report(&[&named, &alone], &page, &["--points", "--log", &log.to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
    for (size, dark) in [
        ([1280, 900], false),
        ([1280, 900], true),
        ([390, 844], false),
        ([390, 844], true),
    ] {
        browser.open(&page, "", size, dark);
        assert_eq!(
            browser.value("document.documentElement.dataset.theme"),
            if dark { "dark" } else { "light" }
        );
        let wide = "document.documentElement.scrollWidth <= innerWidth";
        assert_eq!(browser.value(wide), true, "the page scrolls sideways at {size:?}");
        assert_eq!(browser.value("document.querySelectorAll('#panes canvas').length"), 2);
        assert!(browser.picture().len() > 10_000);
    }
    browser.open(&page, "", [1280, 900], false);
    assert_eq!(
        browser.value("document.querySelector('.score .name').textContent"),
        NAME
    );
    assert_eq!(
        browser.value("document.querySelectorAll('img:not(.picture img)').length"),
        0,
        "a name stays text"
    );

    // Keys: steps, then playing to the end.
    browser.value("seek(0)");
    browser.press("ArrowRight");
    assert_eq!(browser.value("state.at"), 1);
    browser.press("ArrowLeft");
    assert_eq!(browser.value("state.at"), 0);
    browser.value("state.speed = 10");
    browser.press(" ");
    browser.wait("!state.playing && state.at === timeline().length - 1");

    // A click on a box tells its story, in both runs; it stays with its track.
    browser.value("seek(10)");
    let at = browser.value(
        "(() => { const { at } = panes[0].shown.find(({ one }) => one.object);
          const { left, top } = panes[0].canvas.getBoundingClientRect(); return [at[0] + left, at[1] + top]; })()",
    );
    browser.value("byId('player').scrollIntoView({ behavior: 'instant' })");
    let at = match at.as_array() {
        Some(_) => browser.value(
            "(() => { const { at } = panes[0].shown.find(({ one }) => one.object);
              const { left, top } = panes[0].canvas.getBoundingClientRect(); return [at[0] + left, at[1] + top]; })()",
        ),
        None => panic!("no box that found an object"),
    };
    for kind in ["mousePressed", "mouseReleased"] {
        let params = serde_json::json!({"type": kind, "x": at[0], "y": at[1], "button": "left", "clickCount": 1});
        browser.call("Input.dispatchMouseEvent", params);
    }
    let story = browser.value("byId('story').textContent");
    let story = story.as_str().unwrap_or_default();
    assert!(
        story.contains("class") && story.contains("score") && story.contains("points of rsu1"),
        "{story}"
    );

    // Filters leave only what they name.
    browser.value("state.klass = 'pedestrian'; draw()");
    assert_eq!(
        browser.value("panes[0].shown.every(({ one }) => one.klass === 'pedestrian')"),
        true
    );
    browser.value("state.klass = ''; state.hidden = new Set(['hit', 'added', 'missed', 'other']); draw()");
    assert_eq!(
        browser.value("panes.every((pane) => pane.shown.every(({ one }) => one.fate === 'false'))"),
        true
    );
    browser.value("state.hidden = new Set(); draw()");

    // After a click on an object Space plays; it does not click again.
    browser.value("byId('added').querySelector('button').focus(); byId('added').querySelector('button').click()");
    assert_eq!(browser.value("document.activeElement === panes[0].canvas"), true);
    browser.press(" ");
    assert_eq!(browser.value("state.playing"), true);
    browser.value("play(false); seek(10)");

    // A flow for the run that has messages, which names what became of all, and bytes beside ages.
    let captions = "[...document.querySelectorAll('#flows figcaption')].map((one) => one.firstChild.textContent)";
    let captions: Vec<String> = serde_json::from_value(browser.value(captions)).expect("texts");
    let flows: Vec<&String> = captions
        .iter()
        .filter(|one| one.starts_with("Flow of messages"))
        .collect();
    assert_eq!(flows, [&format!("Flow of messages: {NAME}")], "{captions:?}");
    let flow = "[...document.querySelectorAll('#flows svg')].find((one) => /^Of .* messages/.test(one.getAttribute('aria-label')))";
    let words = browser.value(&format!("{flow}.getAttribute('aria-label')"));
    let result = json(&late.join(format!("{LOG}/cav1/result.json")));
    let links = result["links"].as_object().expect("links").values();
    let sent: u64 = links.filter_map(|kinds| kinds["boxes"]["sent"].as_u64()).sum();
    assert!(
        words.as_str().is_some_and(
            |words| words.starts_with(&format!("Of {sent} messages: ")) && words.contains("lost on the link")
        ),
        "{words}"
    );
    let heights =
        format!("[...{flow}.querySelectorAll('path')].every((one) => !one.getAttribute('d').includes('NaN'))");
    assert_eq!(browser.value(&heights), true);
    let bytes = captions
        .iter()
        .position(|one| one == "KB over time")
        .expect("bytes over time");
    assert!(
        captions[..bytes].iter().any(|one| one == "Age over time"),
        "{captions:?}"
    );
    let drawn = "[...document.querySelectorAll('#flows figure')].find((one) => one.textContent.startsWith('KB over time')).querySelectorAll('path').length";
    assert_eq!(browser.value(drawn), 1, "one run sent something");

    // In space, with points; the address keeps the place.
    browser.press("3");
    assert_eq!(browser.value("state.view"), "3d");
    browser.wait("location.hash.includes('view=3d') && location.hash.includes('pick=')");
    let mut hash = browser.value("location.hash");
    let place = "JSON.stringify([state.at, state.view, state.picked, state.runs, camera.scale.toFixed(2)])";
    let before = browser.value(place);
    assert_eq!(browser.value("decoded.size > 0"), true, "points are drawn");
    browser.open(&page, hash.as_str().unwrap_or_default(), [1280, 900], true);
    assert_eq!(browser.value(place), before);

    // What is asked of charts and tables, too.
    let choose = |label: &str, value: &str| {
        format!(
            "(() => {{ const one = [...document.querySelectorAll('label')].find((one) => one.textContent.startsWith('{label}') && \
             one.closest('#choices, #added')).querySelector('select'); one.value = [...one.options].find((option) => option.text === \
             '{value}').value; one.dispatchEvent(new Event('change')); return one.value; }})()"
        )
    };
    browser.value(&choose("Class", "vehicle"));
    browser.value(&choose("IoU", "0.3"));
    browser.wait("location.hash.includes('charts-klass=vehicle') && location.hash.includes('charts-iou=0.3')");
    hash = browser.value("location.hash");
    browser.open(&page, hash.as_str().unwrap_or_default(), [1280, 900], false);
    assert_eq!(browser.value("asked.klass + asked.iou"), "vehicle0.3");

    // The graph is drawn as `realo graph` draws it, and runs with detections of the log say so.
    let drawn = "[...document.querySelectorAll('#graphs img')].map((one) => one.naturalWidth > 300).join()";
    browser.wait(&format!("{drawn} === 'true,true'"));
    assert_eq!(
        browser.value("document.getElementById('setup').textContent.includes('detections recorded')"),
        true
    );
    let elsewhere = "#scene=9&sweep=-4&runs=7.x&class=%3Cb%3E&pick=box.1.2&at=1,2,NaN";
    browser.open(&page, elsewhere, [1280, 900], false);
    assert_eq!(
        browser.value("panes.length"),
        2,
        "an address of another page is taken as far as it fits"
    );
    assert_eq!(browser.said, [""; 0], "the console of the page");
}

#[test]
fn points_are_those_of_the_log() {
    let page = folder("report_points").join("report.html");
    let [late, _] = runs();
    let (code, said) = report(&[&late], &page, &["--points", "--log", &log().to_string_lossy()]);
    assert_eq!(code, Some(0), "{said}");
    let document = document(&page);
    let clouds = document["points"].as_array().unwrap();
    assert_eq!(clouds.len(), 60, "two agents, 3 s");
    let text = fs::read_to_string(&page).unwrap();
    let points = text
        .split_once("id=\"points\">")
        .unwrap()
        .1
        .split_once("</script>")
        .unwrap()
        .0;
    let last = clouds.last().unwrap()["text"].as_array().unwrap();
    let end = last[0].as_u64().unwrap() + last[1].as_u64().unwrap();
    assert_eq!(points.len() as u64, end);
    assert!(text.len() < 40_000_000, "{} bytes", text.len());

    // One sweep, point by point: the page keeps the order of the log.
    let part = clouds
        .iter()
        .filter(|part| part["agent"] == "cav1")
        .nth(10)
        .expect("it has 30 sweeps");
    let number = |value: &Value| value.as_i64().expect("a number");
    let start: i64 = document["scenes"][0]["start"]
        .as_str()
        .expect("a text")
        .parse()
        .expect("ns");
    let log = Log::open(log()).expect("the log opens");
    let mut reader = log.read_all(&[("cav1", Stream::Points)]).expect("it has the points");
    let entry = loop {
        let entry = reader.next().expect("it can be read").expect("it has the sweep");
        if (entry.stamp() - start) / 1_000_000 == number(&part["t"]) {
            break entry;
        }
    };
    let track = pose_track(&log, "cav1", Stream::Pose, MAX_GAP).expect("it has poses");
    let pose = track.at(entry.stamp()).expect("the ego has a pose");
    let map = pose * pose.inverse();
    let cloud = entry.cloud().expect("a cloud");
    let in_map = in_ego_frame(&cloud, entry.stamp(), &track, &map, &pose);
    let from = [0usize, 1, 2].map(|axis| number(&part["from"][axis]) as f64 / 100.0);
    // The page counts from a place of whole metres.
    let origin = [0usize, 1, 2].map(|axis| (pose.translation.vector[axis] - from[axis]).round());
    let [begin, length] = [0usize, 1].map(|at| number(&part["text"][at]) as usize);
    let steps = steps(&points[begin..begin + length]);
    assert!(steps.len() > 3 * 1000, "{} numbers", steps.len());
    let mut logged = in_map.iter();
    for step in steps.chunks(3) {
        let shown = [0usize, 1, 2].map(|axis| origin[axis] + from[axis] + 0.02 * f64::from(step[axis]));
        let is_near = |point: &[f32; 3]| {
            let squares = [0usize, 1, 2].map(|axis| (f64::from(point[axis]) - shown[axis]).powi(2));
            squares.iter().sum::<f64>() < 0.02_f64.powi(2)
        };
        assert!(logged.any(is_near), "no point of the log is at {shown:?}");
    }
}

/// The numbers of 16 bits in a text of base64 without a rest.
fn steps(text: &str) -> Vec<i16> {
    let value = |letter: u8| {
        u32::from(match letter {
            b'A'..=b'Z' => letter - b'A',
            b'a'..=b'z' => letter - b'a' + 26,
            b'0'..=b'9' => letter - b'0' + 52,
            b'+' => 62,
            _ => 63,
        })
    };
    let bits = |four: &[u8]| four.iter().fold(0u32, |bits, letter| bits << 6 | value(*letter));
    let bytes: Vec<u8> = text
        .as_bytes()
        .chunks(4)
        .flat_map(|four| bits(four).to_be_bytes().into_iter().skip(1))
        .collect();
    bytes
        .chunks(2)
        .map(|two| i16::from_le_bytes([two[0], two[1]]))
        .collect()
}

#[test]
fn without_the_log_the_recording_says_how_large_agents_are() {
    let home = folder("report_outlines");
    let [late, _] = runs();
    let gone = home.join("gone");
    copied(&late, &gone);
    for file in ["timing.json".to_string(), format!("{LOG}/cav1/timing.json")] {
        let file = gone.join(file);
        let text = fs::read_to_string(&file).expect("it is there");
        fs::write(&file, text.replace(&format!("{LOG}.mcap"), "gone.mcap")).expect("it can be written");
    }
    let page = |run: &Path, name: &str, more: &[&str]| {
        let page = home.join(name);
        let (code, said) = report(&[run], &page, more);
        assert_eq!(code, Some(0), "{said}");
        assert!(!said.contains("has no outlines"), "{said}");
        document(&page)["scenes"][0].clone()
    };
    let (with, without) = (
        page(&late, "with.html", &["--log", &log().to_string_lossy()]),
        page(&gone, "without.html", &[]),
    );
    assert_ne!(with["start"], without["start"], "the log is not found");
    let outline = &without["agents"][0]["footprint"];
    assert!(
        outline.is_array() && *outline == with["agents"][0]["footprint"],
        "{outline}"
    );
    // Boxes on the ego itself are the ego: everything is judged as with the log.
    let judged = |scene: &Value| -> Vec<Value> {
        let frames = scene["runs"][0]["frames"].as_object().expect("sweeps");
        frames.values().map(|frame| frame["boxes"].clone()).collect()
    };
    assert_eq!(judged(&with), judged(&without));
}

#[test]
fn wrong_input_gets_a_clear_error() {
    let home = folder("report_errors");
    let [late, _] = runs();
    let page = home.join("report.html");
    let said = |runs: &[&Path], output: &Path, args: &[&str], words: &[&str]| {
        let (code, said) = report(runs, output, args);
        assert_eq!(code, Some(1), "{said}");
        assert!(words.iter().all(|word| said.contains(word)), "{words:?}: {said}");
        assert!(!output.exists() || output.ends_with("mine.html"), "nothing is written");
    };
    said(&[&home.join("gone")], &page, &[], &["gone", "no such folder"]);
    said(
        &[&late],
        &home.join("report.pdf"),
        &[],
        &["report.pdf", ".html", "found .pdf"],
    );
    said(
        &[&late],
        &page,
        &["--log", "gone.mcap"],
        &["gone.mcap", "no such file", "--log"],
    );
    // A log of another scene; the right one under another name is taken.
    let args = ["--seed", "912", "--seconds", "1", "--agents", "cav1,rsu1"];
    let other_log = simulated("report_other_log", &args);
    said(
        &[&late],
        &page,
        &["--log", &other_log.to_string_lossy()],
        &["report_other_log", "expected the log `report_small`", "--log"],
    );
    let renamed = home.join("renamed.mcap");
    fs::copy(log(), &renamed).unwrap();
    let (code, words) = report(
        &[&late],
        &home.join("renamed.html"),
        &["--log", &renamed.to_string_lossy()],
    );
    assert_eq!(code, Some(0), "{words}");
    assert!(!words.contains("not here") && !words.contains("not taken"), "{words}");
    fs::write(home.join("mine.html"), "<html>my notes</html>").unwrap();
    said(
        &[&late],
        &home.join("mine.html"),
        &[],
        &["refuse to overwrite", "mine.html", "--force"],
    );

    // A run of another version, and one whose recording is damaged or of another run.
    let other = home.join("other");
    copied(&late, &other);
    let file = other.join("result.json");
    let changed = fs::read_to_string(&file)
        .unwrap()
        .replace("\"version\": 2", "\"version\": 99");
    fs::write(&file, changed).unwrap();
    said(&[&other], &page, &[], &["result.json", "version 99"]);
    let damaged = home.join("damaged");
    copied(&late, &damaged);
    let recording = damaged.join(format!("{LOG}/cav1/recording.mcap"));
    fs::write(&recording, "no recording").unwrap();
    said(&[&damaged], &page, &[], &["recording.mcap"]);
    let [_, alone] = runs();
    fs::copy(alone.join(format!("{LOG}/cav1/recording.mcap")), &recording).unwrap();
    let words = [
        "damaged",
        "recording.mcap",
        "of another run",
        "evaluation.json",
        "run it again",
    ];
    said(&[&damaged], &page, &[], &words);
}

#[test]
fn of_many_runs_those_that_are_damaged_are_named_and_the_others_shown() {
    let home = folder("report_partial");
    let page = home.join("report.html");
    let [late, alone] = runs();
    let log = log();
    let args = ["--log", &log.to_string_lossy()];
    let swapped = home.join("swapped");
    copied(&late, &swapped);
    fs::copy(
        alone.join(format!("{LOG}/cav1/recording.mcap")),
        swapped.join(format!("{LOG}/cav1/recording.mcap")),
    )
    .expect("it can be copied");
    let cut = home.join("cut");
    copied(&late, &cut);
    fs::write(cut.join("timing.json"), "{").expect("it can be written");
    let gone = home.join("gone");
    let (code, said) = report(&[&late, &cut, &gone, &swapped, &alone], &page, &args);
    assert_eq!(code, Some(3), "{said}");
    for words in [
        "cut: not on this page",
        "timing.json",
        "gone: not on this page",
        "no such folder",
        "swapped: not in the player",
        "of another run",
        "3 runs, 60 sweeps in the player",
    ] {
        assert!(said.contains(words), "{words}: {said}");
    }
    let document = document(&page);
    assert_eq!(document["runs"].as_array().map(Vec::len), Some(3));
    assert_eq!(
        document["left_out"].as_array().map(Vec::len),
        Some(3),
        "the page says it too"
    );
    // The scores of a run are there, its boxes are not.
    let shown: Vec<&Value> = document["scenes"][0]["runs"].as_array().expect("runs").iter().collect();
    assert_eq!(shown.iter().map(|run| &run["run"]).collect::<Vec<_>>(), [0, 2]);
    fs::remove_file(&page).expect("it was written");
    let (code, said) = report(&[&cut, &gone], &page, &args);
    assert_eq!(code, Some(1), "{said}");
    assert!(
        said.contains("none of 2 runs") && said.contains("timing.json") && !page.exists(),
        "{said}"
    );
}

/// Runs of late fusion and of the ego alone over two logs each, and over the second log alone.
fn runs_of_two_logs() -> [PathBuf; 2] {
    let args = ["--seed", "912", "--seconds", "1", "--agents", "cav1,rsu1"];
    let other = simulated("report_other_log", &args);
    let run = |graph: &str| {
        once(&format!("report_two_{graph}"), |_| {
            let other = other.to_string_lossy();
            let args = ["--recorded-detections", "--ego", "cav1", "--log", &other];
            run_virtual(&format!("report_two_{graph}"), graph, &log(), &args);
        })
    };
    [run("late_fusion"), run("no_fusion")]
}

#[test]
fn a_damaged_part_of_a_run_over_several_logs_is_named() {
    let home = folder("report_part");
    let page = home.join("report.html");
    let [late, _] = runs_of_two_logs();
    let parts = |name: &str, change: &dyn Fn(&Path)| {
        let run = home.join(name);
        copied(&late, &run);
        change(&run.join("report_other_log/cav1"));
        let _ = fs::remove_file(&page);
        let (code, said) = report(&[&run], &page, &[]);
        (code, said, document(&page)["scenes"].as_array().map(Vec::len))
    };
    let (code, said, scenes) = parts("whole", &|_| {});
    assert_eq!((code, scenes), (Some(0), Some(2)), "{said}");
    let (code, said, scenes) = parts("damaged", &|part| {
        fs::write(part.join("result.json"), "{").expect("written")
    });
    assert_eq!((code, scenes), (Some(3), Some(1)), "{said}");
    assert!(said.contains("report_other_log/cav1/result.json"), "{said}");
    let (code, said, scenes) = parts("gone", &|part| fs::remove_dir_all(part).expect("removed"));
    assert_eq!((code, scenes), (Some(3), Some(1)), "{said}");
    assert!(
        said.contains("report_other_log/cav1") && said.contains("no such folder"),
        "{said}"
    );
}

#[test]
fn each_run_is_compared_with_the_ego_alone_of_its_own_log() {
    let home = folder("report_margins");
    let page = home.join("report.html");
    let [late, alone] = runs();
    let [late_two, alone_two] = runs_of_two_logs();
    // The parts over the second log are runs of that log.
    let part = |run: &Path| run.join("report_other_log/cav1");
    let (late_other, alone_other) = (part(&late_two), part(&alone_two));
    let (code, said) = report(&[&late, &late_other, &late_two, &alone_other, &alone], &page, &[]);
    assert_eq!(code, Some(0), "{said}");
    let document = document(&page);
    let against: Vec<Value> = (0..5).map(|at| document["runs"][at]["against"].clone()).collect();
    assert_eq!(serde_json::json!(against), serde_json::json!([4, 3, null, null, null]));
    assert_eq!(document["runs"][2]["no_margin"], "logs");
    let verdict = document["verdict"].to_string();
    assert_eq!(verdict.matches("Margin over the ego alone").count(), 2, "{verdict}");
    assert!(
        verdict.contains("no run of the ego alone here has the same logs"),
        "{verdict}"
    );
}

/// A recording in which every report stands several times, as processes may repeat what they heard.
fn with_repeated_reports(from: &Path, to: &Path) {
    let bytes = fs::read(from).expect("it can be read");
    let file = fs::File::create(to).expect("it can be made");
    let mut writer = mcap::Writer::new(std::io::BufWriter::new(file)).expect("a writer");
    let metadata =
        [("format", "1"), ("program", "realo 9.9.9")].map(|(key, value)| (key.to_string(), value.to_string()));
    let record = mcap::records::Metadata {
        name: realo_logs::RECORDING_RECORD.into(),
        metadata: metadata.into(),
    };
    writer.write_metadata(&record).expect("written");
    for message in mcap::MessageStream::new(&bytes).expect("messages") {
        let message = message.expect("a message");
        let times = if message.channel.topic == "/reports" { 7 } else { 1 };
        for _ in 0..times {
            writer.write(&message).expect("written");
        }
    }
    writer.finish().expect("finished");
}

#[test]
fn what_a_recording_says_again_is_counted_once() {
    let home = folder("report_repeated");
    let page = home.join("report.html");
    let [late, _] = runs();
    let again = home.join("again");
    copied(&late, &again);
    let recording = format!("{LOG}/cav1/recording.mcap");
    with_repeated_reports(&late.join(&recording), &again.join(&recording));
    let (code, said) = report(&[&again], &page, &[]);
    assert_eq!(code, Some(0), "{said}");
    let document = document(&page);
    let rows = document["scenes"][0]["runs"][0]["carried"].as_array().expect("rows");
    let sum = |column: usize| {
        rows.iter()
            .map(|row| row[column].as_u64().expect("a number"))
            .sum::<u64>()
    };
    let result = json(&again.join(format!("{LOG}/cav1/result.json")));
    let boxes = &result["links"]["rsu1-cav1"]["boxes"];
    assert_eq!(
        [sum(2), sum(3)],
        ["sent", "bytes"].map(|what| boxes[what].as_u64().expect("a number"))
    );
    assert_eq!(document["runs"][0]["program"], "realo 9.9.9");
}

#[test]
fn a_run_that_was_ended_says_so_first() {
    let home = folder("report_ended");
    let page = home.join("report.html");
    let [late, alone] = runs();
    let ended = home.join("ended");
    copied(&late, &ended);
    for file in ["result.json".to_string(), format!("{LOG}/cav1/result.json")] {
        let mut result = json(&ended.join(&file));
        result["ended_by"] = "Ctrl-C".into();
        fs::write(ended.join(&file), result.to_string()).expect("it can be written");
    }
    let (code, said) = report(&[&ended, &alone], &page, &[]);
    assert_eq!(code, Some(0), "{said}");
    let verdict = document(&page)["verdict"].to_string();
    assert!(
        verdict.contains("Ended before the log was: ended by Ctrl-C, after"),
        "{verdict}"
    );
}

#[test]
fn boxes_of_a_tracker_have_their_tracks_and_objects_the_numbers_of_the_log() {
    let page = folder("report_tracks").join("report.html");
    let run = run("late_fusion_tracked", &[]);
    let (code, said) = report(&[&run], &page, &[]);
    assert_eq!(code, Some(0), "{said}");
    let scene = &document(&page)["scenes"][0];
    let beyond = 9 + scene["ious"].as_array().map_or(0, Vec::len);
    let names = scene["tracks"].as_object().expect("names");
    let frames = scene["runs"][0]["frames"].as_object().expect("sweeps");
    let rows: Vec<&Value> = frames
        .values()
        .flat_map(|frame| frame["boxes"].as_array().expect("boxes"))
        .collect();
    let followed = rows.iter().filter(|row| row[beyond].as_i64() >= Some(0)).count();
    assert!(
        2 * followed > rows.len() && followed > 100,
        "{followed} of {}",
        rows.len()
    );
    let speeds = rows.iter().filter(|row| row[beyond + 2].is_i64()).count();
    assert!(speeds > 0, "velocities are recorded");
    let places = rows
        .iter()
        .filter_map(|row| row[beyond].as_i64())
        .filter(|place| *place >= 0);
    assert!(places.into_iter().all(|place| names.contains_key(&place.to_string())));
    // The numbers of the log, as its own reader gives them.
    let evaluation = json(&run.join(format!("{LOG}/cav1/evaluation.json")));
    let frame = &evaluation["evaluation"]["scenes"][0]["frames"][10];
    let log = Log::open(log()).expect("the log opens");
    let truth = truth(&log, "cav1", frame["stamp"].as_i64().expect("a stamp")).expect("it has truth");
    let tracks = truth.boxes.iter().filter_map(|one| one.track);
    let tracks: Vec<String> = tracks.map(|track| track.to_string()).collect();
    assert!(!tracks.is_empty());
    let known: Vec<&str> = names.values().filter_map(Value::as_str).collect();
    assert!(
        tracks.iter().all(|track| known.contains(&track.as_str())),
        "{tracks:?}: {known:?}"
    );
}

#[test]
fn what_a_run_lacks_is_said_on_the_page() {
    let home = folder("report_lacks");
    let [late, _] = runs();
    let page = home.join("report.html");
    let log = log();
    let log = log.to_string_lossy();
    let bare = home.join("bare");
    copied(&late, &bare);
    let recording = bare.join(format!("{LOG}/cav1/recording.mcap"));
    let whole = fs::read(&recording).unwrap();
    fs::remove_file(&recording).unwrap();
    let (code, said) = report(&[&bare], &page, &["--log", &log]);
    assert_eq!(code, Some(0), "{said}");
    assert!(
        said.contains("recording.mcap is not there") && said.contains("node `recorder`"),
        "{said}"
    );
    assert_eq!(document(&page)["scenes"].as_array().map(Vec::len), Some(0));
    assert_eq!(document(&page)["left_out"].as_array().map(Vec::len), Some(1));
    // Cut: what is before the cut is shown.
    fs::write(&recording, &whole[..whole.len() * 6 / 10]).unwrap();
    let (code, said) = report(&[&bare], &page, &["--log", &log]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("of 30 sweeps: it was cut"), "{said}");
    // The same run a hundred times: the player takes twelve, the tables all.
    let many = vec![&*late; 100];
    let (code, said) = report(&many, &page, &["--log", &log]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.contains("the player holds the 12 best of 100 runs"), "{said}");
    assert!(fs::metadata(&page).unwrap().len() < 5_200_000, "{said}");
    assert_eq!(document(&page)["runs"].as_array().map(Vec::len), Some(100));
    drop(realo_ok(["report", "--help"]));
}
