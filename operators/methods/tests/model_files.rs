//! Model files: what they say, what they extend, and what of them is refused.

use std::path::Path;

use realo_methods::{Model, attfuse, fcooper};
use realo_nn::model::Sharing;

const LITE: &str = include_str!("../../../models/lite.toml");

fn lite() -> Model {
    toml::from_str(LITE).unwrap()
}

#[test]
fn the_model_that_ships_is_valid_and_has_its_sizes() {
    let model = lite();
    model.validate().unwrap();
    assert_eq!((model.grid.rows(), model.grid.columns()), (200, 512));
    assert_eq!((model.map_size(), model.stride()), ([100, 256], 2));
    assert_eq!((model.map_channels(), model.anchors()), (64, 6));
    for class in &model.classes {
        assert_eq!(class.z, class.height / 2.0, "{}", class.name);
    }
}

#[test]
fn a_model_survives_writing_and_reading() {
    let text = toml::to_string(&lite()).unwrap();
    assert_eq!(toml::from_str::<Model>(&text).unwrap(), lite());
}

#[test]
fn finds_the_weights_beside_the_model_file() {
    let path = lite().weights_beside(Path::new("models/lite.toml"));
    assert_eq!(path, [Path::new("models/lite.safetensors")]);
}

#[test]
fn a_model_that_extends_another_says_what_differs() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str, text: &str| {
        let path = dir.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    file("base.toml", LITE);
    let middle = file(
        "middle.toml",
        "extends = \"base.toml\"\nname = \"middle\"\nweights = \"lite\"\n[arch]\nkind = \"attfuse\"\nagents = 3\n",
    );
    let top = file(
        "top.toml",
        "extends = \"middle.toml\"\n[pillars]\npoints = 16\n[arch]\nkind = \"fcooper\"\n",
    );
    let mut expected = lite();
    expected.name = "middle".into();
    expected.weights = Some("lite".into());
    expected.arch = attfuse::Settings(Sharing {
        agents: 3,
        ..Sharing::default()
    })
    .into();
    assert_eq!(Model::read(&middle).unwrap(), expected);
    assert_eq!(expected.weights_beside(&middle), [dir.path().join("lite.safetensors")]);
    let beside = Model {
        encoder: Some("other".into()),
        ..expected.clone()
    };
    assert_eq!(
        beside.weights_beside(&middle),
        ["lite", "other"].map(|stem| dir.path().join(format!("{stem}.safetensors")))
    );
    expected.arch = fcooper::Settings::default().into();
    expected.pillars.points = 16;
    let (model, files) = Model::read_with_files(&top).unwrap();
    let names: Vec<_> = files.iter().filter_map(|(file, _)| file.file_name()).collect();
    assert_eq!(model, expected);
    assert_eq!(names, ["top.toml", "middle.toml", "base.toml"]);

    let error = |text: &str| Model::read(&file("bad.toml", text)).unwrap_err().to_string();
    let cycle = error("extends = \"bad.toml\"");
    assert!(
        cycle.contains("bad.toml: `extends`: more than 8 files in a row"),
        "{cycle}"
    );
    assert!(error("extends = 3").contains("`extends`: expected the name of a model file, found 3"));
    assert!(error("extends = \"none.toml\"").contains("none.toml"));
    assert!(error("extends = \"../base.toml\"").contains("beside it, found `../base.toml`"));
    assert!(error("extends = \"base.toml\"\nwidth = 3").contains("unknown field `width`"));
    assert!(error("extends = \"base.toml\"\nweights = \"../x\"").contains("weights: expected lower-case"));
    assert!(error("extends = \"base.toml\"\nencoder = \"\"").contains("encoder: expected lower-case"));
    assert!(error("extends = \"base.toml\"\nencoder = \"lite\"").contains("encoder: expected another file"));
    assert!(
        error("extends = \"base.toml\"\n[arch]\nkind = \"attfuse\"\ncompression = 7")
            .contains("divisor of the map's 64")
    );
}

#[test]
fn says_everything_that_does_not_fit() {
    type Change = fn(&mut Model);
    let cases: [(Change, &str); 14] = [
        (|m| m.name = "../lite".into(), "name: expected lower-case"),
        (|m| m.classes.clear(), "classes (how many): expected 1 to 64, found 0"),
        (
            |m| m.classes[1].name = "truck".into(),
            "classes[2].name: expected one that no other class has, found `truck` again",
        ),
        (
            |m| m.classes[0].width = f64::NAN,
            "class `vehicle`: expected positive extents",
        ),
        (
            |m| m.classes[2].unmatched = 0.7,
            "class `truck`: expected 0 <= unmatched",
        ),
        (|m| m.score_threshold = f32::NAN, "score_threshold"),
        (|m| m.grid.cell = 0.3, "grid.x: expected a whole number of cells"),
        (|m| m.grid.cell = 1e-300, "grid.x: expected at most "),
        (|m| m.grid.x = [5.0, -5.0], "grid.x: expected a range"),
        (|m| m.pillars.points = 0, "pillars.points: expected 1 to 65536, found 0"),
        (
            |m| m.backbone.strides = vec![2, 2],
            "backbone.strides: expected 3 entries",
        ),
        (
            |m| m.backbone.up_strides[2] = 2,
            "block 2: expected a map of 100x256 after enlarging, found 50x128",
        ),
        (|m| m.shrink[0].kernel = 5, "shrink[0].kernel: expected 1 or 3, found 5"),
        (
            |m| m.pillars.channels = 4096,
            "expected maps of at most 268435456 numbers in all, found",
        ),
    ];
    for (change, expected) in cases {
        let mut model = lite();
        change(&mut model);
        let error = model.validate().unwrap_err().to_string();
        assert!(error.contains(expected), "expected `{expected}` in: {error}");
    }
    let mut model = lite();
    model.pillars.points = 0;
    model.rotations.clear();
    let error = model.validate().unwrap_err().to_string();
    assert!(
        error.contains("pillars.points") && error.contains("rotations"),
        "{error}"
    );
}

#[test]
fn refuses_files_that_are_no_models() {
    let dir = tempfile::tempdir().unwrap();
    let read = |text: String| {
        let path = dir.path().join("m.toml");
        std::fs::write(&path, text).unwrap();
        Model::read(&path).unwrap_err().to_string()
    };
    assert!(
        Model::read(&dir.path().join("none.toml"))
            .unwrap_err()
            .to_string()
            .contains("none.toml")
    );
    assert!(read("name = 3".into()).contains("m.toml"));
    assert!(read(LITE.replace("cell =", "cel =")).contains("unknown field `cel`"));
    assert!(read(LITE.replace("\"body\"", "\"map\"")).contains("unknown variant `map`"));
    assert!(read(LITE.replace("points = 32\n", "")).contains("missing field `points`"));
    assert!(read(LITE.replace("points = 32\n", "points = -1\n")).contains("invalid value"));
    assert!(read(LITE.replace("kernel = 1", "kernel = 2")).contains("expected 1 or 3, found 2"));
    let long = read(format!("{LITE}#{}", " ".repeat(1 << 20)));
    assert!(long.contains("m.toml: expected at most 1048576 bytes"), "{long}");
    let of = |arch: &str| LITE.replace("[grid]", &format!("[arch]\n{arch}\n\n[grid]"));
    assert!(read(of("kind = \"dream\"")).contains("unknown variant `dream`, expected one of `pointpillars`"));
    assert!(read(of("kind = \"pointpillars\"\nratio = 3")).contains("unknown field `ratio`"));
    let path = dir.path().join("m.toml");
    std::fs::write(&path, of("kind = \"pointpillars\"")).unwrap();
    assert_eq!(Model::read(&path).unwrap(), lite());
}

#[test]
fn the_height_of_a_lidar_belongs_to_its_frame() {
    let with = |frame: &str, height: &str| {
        let text = LITE.replace(
            "frame = \"body\"",
            &format!("frame = \"{frame}\"\nlidar_height = {height}"),
        );
        Model::parse(text.as_bytes(), Path::new("m.toml"))
    };
    let model = with("lidar", "1.9").unwrap();
    assert_eq!(model.height(), 1.9);
    model.check_frame(Path::new("m.toml")).unwrap();
    for (frame, height, expected) in [
        ("body", "1.9", "only with frame = \"lidar\""),
        ("lidar", "-1.0", "expected 0 to 100 m, found -1"),
        ("lidar", "nan", "expected 0 to 100 m"),
    ] {
        let error = with(frame, height).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    }
    let none = LITE.replace("frame = \"body\"", "frame = \"lidar\"");
    let none = Model::parse(none.as_bytes(), Path::new("m.toml")).unwrap();
    let error = none.check_frame(Path::new("m.toml")).unwrap_err().to_string();
    assert!(error.starts_with("m.toml: `lidar_height`: expected metres"), "{error}");
}
