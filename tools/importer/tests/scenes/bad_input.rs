//! What is missing or damaged is named, all of it, with what was expected, found, and what to try.

use std::fs;
use std::path::{Path, PathBuf};

use realo_importer::{importer, look_at};

use crate::AGENTS;
use crate::layouts::{OPV2V, Style, V2X_REAL, write};
use crate::reading::import;
use crate::round_trip::edit;

fn made(style: &Style) -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (data, out) = (dir.path().join("data"), dir.path().join("out.mcap"));
    style.write(&data.join("scene"), &AGENTS);
    (dir, data, out)
}

#[test]
fn all_that_is_missing_or_damaged_is_listed_at_once_and_can_be_left_out() {
    let style = Style { frames: 6, ..OPV2V };
    let (_dir, data, out) = made(&style);
    let scene = data.join("scene");
    fs::remove_file(scene.join("641/000068.pcd")).unwrap();
    fs::remove_file(scene.join("650/000070.yaml")).unwrap();
    fs::write(scene.join("-1/000070.pcd"), b"").unwrap();
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 5\n";
    fs::write(scene.join("650/000072.pcd"), pointer).unwrap();
    edit(&scene.join("641/000074.yaml"), |text| {
        text[..text.rfind("extent").unwrap()].into()
    });
    let cloud = fs::read(scene.join("641/000074.pcd")).unwrap();
    fs::write(scene.join("641/000074.pcd"), &cloud[..cloud.len() / 2]).unwrap();
    fs::create_dir_all(scene.join("700")).unwrap();
    let error = import("opv2v", &data, &out, &[]).unwrap_err();
    for line in [
        "4 of 6 frames are incomplete; missing or damaged:",
        "2 × no such file\n    scene/641/000068.pcd\n    scene/650/000070.yaml",
        "1 × an empty file\n    scene/-1/000070.pcd",
        "scene/650/000072.pcd: expected the file itself, found a pointer of Git LFS; run `git lfs pull`",
        "scene/641/000074.yaml: vehicles: object `1`: expected a key `extent`",
        "scene/641/000074.pcd: expected ",
        "1 × folder of an agent without frames\n    scene/700",
        "--skip-incomplete",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
    assert!(!out.exists());
    let summary = &import("opv2v", &data, &out, &[("skip-incomplete", "")]).unwrap()[0];
    assert_eq!((summary.frames, summary.incomplete_frames), (2, 4));
    assert!(
        summary
            .to_string()
            .contains("left out: 4 frames; missing or damaged:\n  1 × an empty file"),
        "{summary}"
    );
    // Nothing but incomplete frames is no log.
    let set = [("skip-incomplete", ""), ("frames", "68..76")];
    let error = import("opv2v", &data, &out, &set).unwrap_err();
    assert!(error.contains("no frame is complete"), "{error}");
}

#[test]
fn what_is_no_regular_file_is_refused_and_not_waited_for() {
    let (_dir, data, out) = made(&OPV2V);
    for name in ["641/000070.pcd", "650/000070.yaml"] {
        let pipe = data.join("scene").join(name);
        fs::remove_file(&pipe).unwrap();
        let made = std::process::Command::new("mkfifo").arg(&pipe).status().unwrap();
        assert!(made.success());
    }
    let device = data.join("scene/-1/000070.pcd");
    fs::remove_file(&device).unwrap();
    std::os::unix::fs::symlink("/dev/zero", &device).unwrap();
    let error = import("opv2v", &data, &out, &[]).unwrap_err();
    for line in [
        "2 × a named pipe, expected a file; put the file itself there\n    scene/641/000070.pcd\n    scene/650/000070.yaml",
        "1 × a device, expected a file; put the file itself there\n    scene/-1/000070.pcd",
    ] {
        assert!(error.contains(line), "{line} is not in\n{error}");
    }
}

#[test]
fn a_file_that_says_something_else_is_refused_by_its_field() {
    let (_dir, data, out) = made(&OPV2V);
    let file = data.join("scene/641/000070.yaml");
    let sound = fs::read_to_string(&file).unwrap();
    let change = |from: &str, to: &str| {
        let changed = sound.replacen(from, to, 1);
        assert_ne!(changed, sound, "{from}");
        changed
    };
    let cut = |at: &str| sound[..sound.find(at).unwrap()].to_string();
    for (text, named) in [
        (cut("lidar_pose"), "expected the pose of the LiDAR, a key `lidar_pose`"),
        (
            cut("vehicles"),
            "vehicles: expected the objects by their ids, `{}` where there are none, found no such key",
        ),
        (
            cut("  11:"),
            "vehicles: expected the objects by their ids, `{}` where there are none, found nothing",
        ),
        (String::from("{lidar_pose: [1, 2"), "if the file was cut, fetch it anew"),
        (
            String::from("- 1\n- 2\n"),
            "expected keys and values, found a list of 2",
        ),
        (change("- 1.9", "- high"), "lidar_pose: expected numbers, found `high`"),
        (change("- 1.9", "- .nan"), "lidar_pose: expected a place within 8e7 m"),
        (
            change("- 1.9\n", ""),
            "lidar_pose: expected x, y, z, roll, yaw, pitch (m, degrees) or a 4×4 matrix, found 5 numbers",
        ),
        (
            change("- -1.0", "- 170.0"),
            "lidar_pose: expected a LiDAR that tilts by at most 45°, found 170.0°",
        ),
        (change("angle", "angles"), "object `11`: expected a key `angle`"),
        (
            change("extent: [2.2", "extent: [220.0"),
            "object `11` (`Car`): expected a box of more than 0, at most 100 m, within 1000 m of its agent",
        ),
        (
            change("extent: [2.2", "extent: [-2.2"),
            "extent: expected half sizes of 0 or more",
        ),
        (
            change("location: [", "location: [9e9, "),
            "location: expected 3 finite numbers",
        ),
        (change("  12:", "  11:"), "duplicate entry"),
    ] {
        fs::write(&file, text).unwrap();
        let error = import("opv2v", &data, &out, &[]).unwrap_err();
        assert!(
            error.contains("scene/641/000070.yaml: ") && error.contains(named),
            "{named} is not in\n{error}"
        );
    }
    for (bytes, named) in [
        (b"\xff\xfev\0".to_vec(), "expected UTF-8, found UTF-16"),
        (b"a: \xff\n".to_vec(), "expected UTF-8, found another byte at 3"),
    ] {
        fs::write(&file, bytes).unwrap();
        let error = import("opv2v", &data, &out, &[]).unwrap_err();
        assert!(error.contains(named), "{error}");
    }
    assert!(!out.exists());
}

#[test]
fn another_folder_is_refused_with_what_was_expected() {
    let (dir, data, out) = made(&OPV2V);
    let refused = |kind: &str, folder: &str, named: &str| {
        let error = import(kind, &data.join(folder), &out, &[]).unwrap_err();
        assert!(error.contains(named), "{kind} {folder}: {named} is not in\n{error}");
    };
    refused("opv2v", "nowhere", "expected the folder of a data set, found nothing");
    refused(
        "opv2v",
        "scene/641/000068.pcd",
        "expected the folder of a data set, found a file",
    );
    refused(
        "opv2v",
        "scene/641",
        "found the frames of one agent; give the folder that it is in",
    );
    refused(
        "kitti",
        "",
        "there is no folder `velodyne`, no `label_2`, no `calib`; expected velodyne/000000.bin",
    );
    fs::create_dir_all(dir.path().join("data/empty/scene/5")).unwrap();
    refused(
        "opv2v",
        "empty",
        "expected SCENE/AGENT/000000.yaml with 000000.pcd or .bin beside it",
    );
    refused("opv2v", "empty", "1 × folder of an agent without frames\n    scene/5");
    refused("v2x-real", "empty", "see what `import auto` says of this folder");
}

#[test]
fn a_folder_of_another_kind_is_named_with_the_command_that_takes_it() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out.mcap");
    let [opv2v, v2x_real, kitti] = ["opv2v", "v2x-real", "kitti"].map(|kind| dir.path().join(kind));
    OPV2V.write(&opv2v.join("scene"), &AGENTS);
    V2X_REAL.write(&v2x_real.join("scene"), &AGENTS);
    for part in ["velodyne/000000.bin", "label_2/000000.txt", "calib/000000.txt"] {
        write(&kitti.join("training").join(part), b"");
    }
    for (asked, data, is) in [
        ("v2x-real", &opv2v, "opv2v"),
        ("v2v4real", &opv2v, "opv2v"),
        ("kitti", &opv2v, "opv2v"),
        ("dair", &opv2v, "opv2v"),
        ("bag", &opv2v, "opv2v"),
        ("opv2v", &v2x_real, "v2x-real"),
        ("cooperscene", &v2x_real, "v2x-real"),
        ("cooperscene", &opv2v, "opv2v"),
        ("opv2v", &kitti.join("training"), "kitti"),
        ("numpy", &kitti.join("training"), "kitti"),
        // One folder above the root, which scenes of the other layout could be in.
        ("opv2v", &kitti, "kitti"),
    ] {
        let error = importer(asked)
            .unwrap()
            .job(data, &out, &importer(asked).unwrap().kind().defaults());
        let error = error.err().unwrap_or_else(|| panic!("{asked} of {is}")).to_string();
        let root = if *data == kitti {
            kitti.join("training")
        } else {
            data.clone()
        };
        let command = format!("try `realo-lab import {is} {} -o LOG`", root.display());
        for part in [&format!("looks like `{is}`, because "), &command] {
            assert!(error.contains(part.as_str()), "{part} is not in\n{error}");
        }
    }
    // The root of its own kind one folder down, or up.
    for (asked, near, next) in [
        ("kitti", &kitti, kitti.join("training")),
        ("kitti", &kitti.join("training/velodyne"), kitti.join("training")),
        ("opv2v", &opv2v.join("scene/641"), opv2v.join("scene")),
    ] {
        let error = import(asked, near, &out, &[]).unwrap_err();
        let next = next.canonicalize().unwrap_or(next);
        let command = format!("try `realo-lab import {asked} {} -o LOG`", next.display());
        assert!(error.contains(&command), "{command} is not in\n{error}");
    }
    assert!(!out.exists());
}

#[test]
fn what_nothing_tells_apart_is_taken_as_named_and_said() {
    let style = Style { head: |_| "", ..OPV2V };
    let (_dir, data, out) = made(&style);
    let set = [("handed", "left"), ("level", "pose"), ("cloud", "pcd")];
    let summary = &import("v2x-real", &data, &out, &set).unwrap()[0];
    let line = "has no key that tells V2X-Real from OPV2V: taken as `v2x-real`, as it was named";
    assert!(summary.assumed[0].contains(line), "{summary}");
    let known = &import("opv2v", &data, &out.with_file_name("known.mcap"), &[]).unwrap()[0];
    assert!(!known.to_string().contains("as it was named"), "{known}");
}

#[test]
fn the_kind_of_a_folder_is_found_from_a_folder_above_or_below_too() {
    let dir = tempfile::tempdir().unwrap();
    let data = dir.path().join("data");
    for part in ["velodyne/000000.bin", "label_2/000000.txt", "calib/000000.txt"] {
        write(&data.join("training").join(part), b"");
    }
    let root = data.join("training").canonicalize().unwrap();
    let command = |root: &Path| format!("try `realo-lab import kitti {} -o LOG`", root.display());
    let said = |folder: &Path| look_at(folder).only(folder).err().unwrap().to_string();
    for (folder, root) in [
        (data.clone(), data.join("training")),
        (root.join("velodyne"), root.clone()),
        (root.join("velodyne/000000.bin"), root.clone()),
    ] {
        let error = said(&folder);
        assert!(error.ends_with(&command(&root)), "{error}");
    }
    let nothing = said(&dir.path().join("nowhere"));
    assert!(nothing.contains("found nothing; correct the path"), "{nothing}");
    fs::create_dir_all(dir.path().join("empty")).unwrap();
    let empty = said(&dir.path().join("empty"));
    assert!(empty.contains("`realo-lab import --list`"), "{empty}");
    // Beside scenes of one kind, a folder of another.
    OPV2V.write(&data.join("opv2v/scene"), &AGENTS);
    let seen = look_at(&data);
    assert_eq!(seen.only(&data).unwrap().kind().name, "opv2v", "{seen}");
    let next = seen.next(&data);
    assert!(
        next.starts_with("import it: `realo-lab import opv2v ") && next.contains(&command(&data.join("training"))),
        "{next}"
    );
}

#[test]
fn rows_of_another_width_are_refused_and_can_be_set() {
    let (_dir, data, out) = made(&V2X_REAL);
    let file = data.join("scene/641/000030.bin");
    let rows = fs::read(&file).unwrap();
    let wide: Vec<u8> = rows.chunks(16).flat_map(|row| [row, &[0; 4][..]].concat()).collect();
    write(&file, &wide[..wide.len() - wide.len() % 80 - 60]);
    let error = import("v2x-real", &data, &out, &[]).unwrap_err();
    assert!(
        error.contains("expected rows of 4 float32 (16 bytes)") && error.contains("it fits --columns 5"),
        "{error}"
    );
    for agent in ["641", "650", "-1"] {
        for number in 30..33 {
            let file = data.join(format!("scene/{agent}/{number:06}.bin"));
            if (agent, number) != ("641", 30) {
                let rows = fs::read(&file).unwrap();
                write(
                    &file,
                    &rows
                        .chunks(16)
                        .flat_map(|row| [row, &[0; 4][..]].concat())
                        .collect::<Vec<u8>>(),
                );
            }
        }
    }
    import("v2x-real", &data, &out, &[("columns", "5")]).unwrap();
}

#[test]
fn rows_of_another_width_that_fit_by_chance_are_refused() {
    let (_dir, data, out) = made(&V2X_REAL);
    for agent in ["641", "650", "-1"] {
        for number in 30..33 {
            let file = data.join(format!("scene/{agent}/{number:06}.bin"));
            let rows = fs::read(&file).unwrap();
            let wide = rows.chunks(16).flat_map(|row| [row, &3f32.to_le_bytes()[..]].concat());
            let wide: Vec<u8> = wide.collect();
            write(&file, &wide[..wide.len() - wide.len() % 80]);
        }
    }
    let error = import("v2x-real", &data, &out, &[]).unwrap_err();
    assert!(
        error.contains("read as rows of 4 float32") && error.contains("give --columns 5"),
        "{error}"
    );
    let summary = import("v2x-real", &data, &out, &[("columns", "5")]).unwrap().remove(0);
    let said = summary.to_string();
    assert!(said.contains("points in `.bin` are rows of 5 float32"), "{said}");
}
