//! Parts of a data set, and what its stamps and classes are taken for.

use realo_importer::{KINDS, importer, list};
use realo_logs::Log;

use crate::AGENTS;
use crate::layouts::{OPV2V, Style};
use crate::reading::{import, read};

#[test]
fn an_import_goes_on_where_it_ended_and_is_the_same_for_any_number_of_jobs() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    for minute in 20..26 {
        OPV2V.write(&data.join(format!("2021_08_16_22_{minute}_54")), &AGENTS);
    }
    let folder = |name: &str| dir.path().join(name);
    let logs = |name: &str| -> Vec<(String, Vec<u8>)> {
        let mut logs: Vec<(String, Vec<u8>)> = std::fs::read_dir(folder(name))
            .unwrap()
            .map(|entry| entry.unwrap())
            .map(|entry| {
                (
                    entry.file_name().to_string_lossy().into_owned(),
                    std::fs::read(entry.path()).unwrap(),
                )
            })
            .collect();
        logs.sort();
        logs
    };
    import("opv2v", &data, &folder("one"), &[("jobs", "1")]).unwrap();
    import("opv2v", &data, &folder("four"), &[("jobs", "4")]).unwrap();
    assert_eq!(logs("one").len(), 6);
    assert!(logs("one") == logs("four"));
    std::fs::remove_file(folder("four").join("2021_08_16_22_23_54.mcap")).unwrap();
    let summaries = import("opv2v", &data, &folder("four"), &[("resume", "")]).unwrap();
    let there: Vec<bool> = summaries.iter().map(|summary| summary.was_there).collect();
    assert_eq!(there, [true, true, true, false, true, true]);
    assert!(
        summaries[0].to_string().contains("its log is there and stays as it is"),
        "{}",
        summaries[0]
    );
    assert!(logs("one") == logs("four"));
    let [one, other] = ["2021_08_16_22_20_54.mcap", "2021_08_16_22_21_54.mcap"].map(|name| folder("four").join(name));
    std::fs::copy(one, &other).unwrap();
    let error = import("opv2v", &data, &folder("four"), &[("resume", "")]).unwrap_err();
    assert!(
        error.contains("expected the log of `OPV2V, scene `2021_08_16_22_21_54``"),
        "{error}"
    );
    std::fs::write(other, b"half").unwrap();
    let error = import("opv2v", &data, &folder("four"), &[("resume", "")]).unwrap_err();
    assert!(error.contains("22_21_54.mcap"), "{error}");
}

#[test]
fn each_scene_is_a_log_and_one_can_be_chosen() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("logs"));
    OPV2V.write(&data.join("train/2021_08_16_22_26_54"), &AGENTS);
    OPV2V.write(&data.join("test/2021_08_18_19_48_05"), &AGENTS[..2]);
    let log = dir.path().join("one.mcap");
    let error = import("opv2v", &data, &log, &[]).unwrap_err();
    assert!(
        error.contains("a log is one scene, and there are 2: `test/2021_08_18_19_48_05`, `train/"),
        "{error}"
    );
    import("opv2v", &data, &out, &[]).unwrap();
    for name in ["train-2021_08_16_22_26_54.mcap", "test-2021_08_18_19_48_05.mcap"] {
        Log::open(out.join(name)).unwrap();
    }
    let chosen = import(
        "opv2v",
        &data,
        &log,
        &[("scenes", "2021_08_16_22_26_54"), ("agents", "650,rsu_1")],
    )
    .unwrap();
    assert_eq!(
        (chosen.len(), chosen[0].scene.as_str()),
        (1, "train/2021_08_16_22_26_54")
    );
    let names: Vec<String> = Log::open(&log)
        .unwrap()
        .info()
        .agents
        .iter()
        .map(|agent| agent.name.clone())
        .collect();
    assert_eq!(names, ["cav_650", "rsu_1"]);
    for (set, named) in [
        (
            ("scenes", "2020"),
            "--scenes: there is no scene `2020`; there are `test/2021_08_18_19_48_05`",
        ),
        (("agents", "7"), "has none of them; it has `641`, `650`"),
        (
            ("agents", "641,65"),
            "--agents: no scene has an agent `65`; there are `-1`, `641`, `650`; correct the name",
        ),
        (
            ("frames", "0..9"),
            "--frames 0..9: scene `test/2021_08_18_19_48_05` has frames 68 to 72",
        ),
        (("rate", "fast"), "--rate: expected 0.1 to 1000 Hz, found `fast`"),
        (
            ("roadside-stamp", "end"),
            "--roadside-stamp: `opv2v` does not take it; it takes --scenes",
        ),
    ] {
        let error = import("opv2v", &data, &out, &[set]).unwrap_err();
        assert!(error.contains(named), "{named} is not in\n{error}");
    }
}

#[test]
fn stamps_heights_and_classes_can_be_told_otherwise() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    OPV2V.write(&data.join("scene"), &AGENTS);
    let set = [
        ("frames", "70.."),
        ("rate", "20"),
        ("stamp", "end"),
        ("height", "1.9"),
        ("class", "Van"),
        ("level", "none"),
    ];
    let summary = &import("opv2v", &data, &out, &set).unwrap()[0];
    let (log, found) = read(&out);
    let start = 1_577_836_800_000_000_000;
    let stamps: Vec<i64> = found.keys().map(|(_, stamp)| stamp - start).collect();
    assert_eq!(
        stamps[..2],
        [50_000_000, 100_000_000],
        "a part has the stamps of the whole"
    );
    for ((_, stamp), read) in &found {
        assert_eq!(read.ready, *stamp);
        assert!(read.truth.iter().all(|object| &*object.class == "Van"));
    }
    assert_eq!(log.info().agents[0].sensor_position, Some([0.0, 0.0, 1.9]));
    assert_eq!(log.levelled().unwrap()["cav_641"].by, "none");
    let said = summary.to_string();
    for line in [
        "assumed: stamps: number 68 is at 1 January 2020, for the scene's name has no date; numbers rise by 2 each 0.0500 s; a stamp \
         is the end of its sweep (--rate, --stamp)",
        "assumed: data set: left-handed, y to the right",
        "assumed: objects without a class are `Van` (--class)",
        "overlap of `cav_641` with `cav_650`: median distance of 0.0",
    ] {
        assert!(said.contains(line), "{line} is not in\n{said}");
    }
}

#[test]
fn the_list_has_every_kind_with_what_it_needs() {
    let list = list();
    for importer in KINDS {
        let kind = importer.kind();
        assert!(
            list.contains(kind.name) && list.contains(kind.title) && list.contains(kind.needs),
            "{list}"
        );
    }
}

#[test]
fn progress_is_reported_after_each_frame_of_a_scene() {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    let style = Style { frames: 7, ..OPV2V };
    style.write(&data.join("scene"), &AGENTS);
    let opv2v = importer("opv2v").unwrap();
    let job = opv2v.job(&data, &out, &opv2v.kind().defaults()).unwrap();
    let mut reported = Vec::new();
    job.run(&mut |step, done, all| reported.push((step, done, all)))
        .unwrap();
    let expected: Vec<_> = (0..=7).map(|done| ("importing", done, 7)).collect();
    assert_eq!(reported, expected);
}
