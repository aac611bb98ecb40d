use std::fs;
use std::ops::ControlFlow;
use std::sync::OnceLock;

use super::*;

const SMALL: &str = include_str!("../../tests/small.toml");

const THREE: &str = r#"
[[stage]]
name = "first"
model = "small.toml"
steps = 3
per_seed = 1
seeds = "0..2"

[[stage]]
name = "second"
model = "small.toml"
from = "first"
steps = 2
per_seed = 1
seeds = "0..2"
freeze = ["encoder"]

[[stage]]
name = "both"
model = "small.toml"
mean = ["first", "second"]
card = { about = "A small detector." }
"#;

fn folder(recipe: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("small.toml"), SMALL).unwrap();
    let file = folder.path().join("small.recipe.toml");
    fs::write(&file, recipe).unwrap();
    (folder, file)
}

fn how(folder: &Path) -> How {
    // Frames that all tests share.
    static CACHE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let cache = CACHE.get_or_init(|| tempfile::tempdir().unwrap());
    How {
        out: folder.join("out"),
        cache: cache.path().into(),
        minutes: None,
        checkpoint_minutes: 0.0,
        threads: Some(2),
        arithmetic: None,
    }
}

fn numbers(made: &Made) -> Vec<f32> {
    let loaded = realo_methods::load(&made.file, realo_methods::Kernels::auto(1)).unwrap();
    let layers = realo_nn::layers::Layers::of(&loaded.model);
    let keys = layers.tensors().map(|spec| spec.key);
    keys.flat_map(|key| loaded.weights.find(&key).unwrap().to_vec())
        .collect()
}

#[test]
fn stages_are_made_once_and_a_recipe_that_was_stopped_goes_on() {
    let (folder, file) = folder(THREE);
    let (recipe, how) = (Recipe::read(&file).unwrap(), how(folder.path()));
    let planned = plan(&recipe, &how).unwrap();
    assert_eq!(
        planned
            .iter()
            .map(|stage| (stage.steps, stage.done))
            .collect::<Vec<_>>(),
        [(3, 0), (2, 0)]
    );
    assert!(planned.iter().all(|stage| stage.pace > 0.0));
    assert!(!how.out.join("pilot").exists());

    let mut steps = 0;
    let stopped = make(&recipe, &how, &mut |news| {
        steps += usize::from(matches!(news, RecipeNews::Training(crate::News::Step(_))));
        if steps == 2 {
            ControlFlow::Break(())
        } else {
            ControlFlow::Continue(())
        }
    });
    assert_eq!((stopped.unwrap(), steps), (None, 2));
    assert_eq!(plan(&recipe, &how).unwrap()[0].done, 2);

    let mut begun = Vec::new();
    let made = make(&recipe, &how, &mut |news| {
        if let RecipeNews::Begins { stage, .. } = news {
            begun.push(stage.name.clone());
        }
        ControlFlow::Continue(())
    });
    let made = made.unwrap().unwrap();
    assert_eq!(begun, ["first", "second", "both"]);
    let [first, second, both] = [0, 1, 2].map(|index| numbers(&made[index]));
    assert!(first != second);
    for ((a, b), mean) in first.iter().zip(&second).zip(&both) {
        assert!(
            ((a + b) / 2.0 - mean).abs() <= 1e-6 * mean.abs().max(1e-3),
            "{a} {b} {mean}"
        );
    }

    let again = make(&recipe, &how, &mut |news| {
        assert!(matches!(news, RecipeNews::There(_)), "{news:?}");
        ControlFlow::Continue(())
    });
    assert_eq!(again.unwrap().unwrap(), made);
}

#[test]
fn a_stage_whose_weights_are_gone_is_made_again_and_one_with_others_is_named() {
    let (folder, file) = folder(THREE);
    let (recipe, how) = (Recipe::read(&file).unwrap(), how(folder.path()));
    let made = |heard: &mut Vec<String>| {
        make(&recipe, &how, &mut |news| {
            match news {
                RecipeNews::There(made) => heard.push(made.stage.name.clone()),
                RecipeNews::Gone { stage, files } => heard.push(format!("{}: {}", stage.name, files.join(" "))),
                _ => {}
            }
            ControlFlow::Continue(())
        })
    };
    let first = made(&mut Vec::new()).unwrap().unwrap();
    let weights = how.out.join("second/small.safetensors");
    let was = fs::read(&weights).unwrap();
    fs::remove_file(&weights).unwrap();
    let mut heard = Vec::new();
    assert_eq!(made(&mut heard).unwrap().unwrap(), first);
    assert_eq!(heard, ["first", "second: small.safetensors", "both"]);
    assert!(fs::read(&weights).unwrap() == was, "its checkpoint gives the same");
    fs::copy(how.out.join("first/small.safetensors"), &weights).unwrap();
    let error = made(&mut Vec::new()).unwrap_err().to_string();
    assert!(
        error.contains("stage `second`") && error.contains("`small.safetensors` had sha256"),
        "{error}"
    );
}

#[test]
fn a_stage_that_diverges_says_what_can_be_done_in_the_recipe() {
    let (folder, file) = folder(&THREE.replacen("steps = 3", "steps = 3\nrate = 1e30", 1));
    let how = How {
        checkpoint_minutes: 100.0,
        ..how(folder.path())
    };
    let said = || {
        let made = make(&Recipe::read(&file).unwrap(), &how, &mut |_| ControlFlow::Continue(()));
        made.unwrap_err().to_string()
    };
    let error = said();
    for part in [
        "stage `first`: diverged at step",
        "give it a lower `rate` in `",
        "begins it again: it had no checkpoint yet",
    ] {
        assert!(error.contains(part), "{part}: {error}");
    }
    assert!(!error.contains("--r"), "no option of a recipe: {error}");
}

#[test]
fn a_stage_that_was_made_otherwise_is_named_with_what_differs() {
    let (folder, file) = folder(THREE);
    let how = how(folder.path());
    let mut go_on = |_: &RecipeNews| ControlFlow::Continue(());
    make(&Recipe::read(&file).unwrap(), &how, &mut go_on).unwrap();
    let changed = THREE
        .replacen("steps = 2", "steps = 4", 1)
        .replace("A small", "Another");
    fs::write(&file, &changed).unwrap();
    let error = make(&Recipe::read(&file).unwrap(), &how, &mut go_on)
        .unwrap_err()
        .to_string();
    for part in ["stage `second`", "steps: was 2, now 4 is asked for", "out/second"] {
        assert!(error.contains(part), "{error}");
    }
    // A key that is there only once is named alone.
    fs::write(&file, THREE.replacen("steps = 2", "steps = 2\nrate = 1e-3", 1)).unwrap();
    let error = make(&Recipe::read(&file).unwrap(), &how, &mut go_on)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("was made otherwise: rate: was not given, now 0.001 is asked for;"),
        "{error}"
    );
    // The one that it began with is made anew, by other draws.
    fs::write(&file, THREE.replacen("steps = 3", "steps = 3\nseed = 9", 1)).unwrap();
    fs::remove_dir_all(how.out.join("first")).unwrap();
    let error = make(&Recipe::read(&file).unwrap(), &how, &mut go_on)
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("stage `second`") && error.contains("`first` had sha256"),
        "{error}"
    );
}

#[test]
fn what_a_recipe_gets_wrong_is_named_with_file_stage_and_key() {
    let refused = |text: &str| {
        let (_folder, file) = folder(text);
        Recipe::read(&file).unwrap_err().to_string()
    };
    let cases = [
        (
            ("name = \"second\"", "name = \"first\""),
            ["`first`", "name: expected a name of its own"],
        ),
        (
            ("from = \"first\"", "from = \"frist\""),
            ["stage `second`: from", "before it are first"],
        ),
        (
            ("mean = [\"first\"", "mean = [\"third\""),
            ["stage `both`: mean", "`third`"],
        ),
        (("steps = 2", "step = 2"), ["unknown field `step`", "small.recipe.toml"]),
        (("steps = 2\n", ""), ["stage `second`: steps", "found neither"]),
        (
            ("steps = 2", "steps = 0"),
            ["stage `second`: steps", "expected at least 1, found 0"],
        ),
        (
            ("freeze = [\"encoder\"]", "freeze = [\"encoder\", \"heads\"]"),
            ["stage `second`: freeze", "something to learn, found encoder, heads"],
        ),
        (
            ("model = \"small.toml\"", "model = \"smal.toml\""),
            ["stage `first`: model", "smal.toml"],
        ),
        (("freeze = [\"encoder\"]", "freeze = [\"head\"]"), ["freeze", "head"]),
        (
            ("seeds = \"0..2\"", "seeds = \"2..0\""),
            ["expected first..end", "2..0"],
        ),
        (
            ("name = \"first\"", "name = \"a/b\""),
            ["name: expected letters", "`a/b`"],
        ),
    ];
    for ((was, is), expected) in cases {
        assert!(THREE.contains(was));
        let error = refused(&THREE.replacen(was, is, 1));
        assert!(expected.iter().all(|part| error.contains(part)), "{was}: {error}");
    }
}

#[test]
fn a_fusion_behind_the_encoder_of_a_stage_before_is_planned_and_made() {
    let of_encoder = r#"
        [[stage]]
        name = "small"
        model = "small.toml"
        steps = 2
        per_seed = 1
        seeds = "0..2"

        [[stage]]
        name = "fusing"
        model = "fusing.toml"
        from = "small"
        teacher = "small"
        steps = 2
        per_seed = 1
        seeds = "0..2"
    "#;
    let (folder, file) = folder(of_encoder);
    let fusing = "extends = \"small.toml\"\nname = \"fusing\"\nencoder = \"small\"\narch = { kind = \"fcooper\" }\n";
    fs::write(folder.path().join("fusing.toml"), fusing).unwrap();
    let (recipe, how) = (Recipe::read(&file).unwrap(), how(folder.path()));
    assert_eq!(plan(&recipe, &how).unwrap().len(), 2);
    let made = make(&recipe, &how, &mut |_| ControlFlow::Continue(()))
        .unwrap()
        .unwrap();
    let encoder = |made: &Made| made.weights.get("small.safetensors").cloned();
    assert!(encoder(&made[1]).is_some(), "{made:?}");
    let loaded = |file: &Path| realo_methods::load(file, realo_methods::Kernels::auto(1)).unwrap();
    let [small, fusing] = [0, 1].map(|index| loaded(&made[index].file));
    for spec in realo_nn::layers::Layers::of(&small.model).encoder() {
        assert_eq!(
            small.weights.find(&spec.key),
            fusing.weights.find(&spec.key),
            "{}",
            spec.key
        );
    }

    let own = |made: &Made, stem: &str| {
        let files = [format!("{stem}.safetensors"), format!("{stem}.toml")];
        files.map(|name| (made.file.with_file_name(&name), name))
    };
    install(&made[0], &own(&made[0], "small"), folder.path()).unwrap();
    install(&made[1], &own(&made[1], "fusing"), folder.path()).unwrap();
    let installed = loaded(&folder.path().join("fusing.toml"));
    for spec in realo_nn::layers::Layers::of(&installed.model).tensors() {
        assert_eq!(
            installed.weights.find(&spec.key),
            fusing.weights.find(&spec.key),
            "{}",
            spec.key
        );
    }
    // Another encoder in the place of that one.
    let other = THREE.replacen("steps = 3", "steps = 3\nseed = 9", 1);
    let (there, file) = self::folder(&other);
    let another = make(&Recipe::read(&file).unwrap(), &self::how(there.path()), &mut |_| {
        ControlFlow::Continue(())
    });
    let another = &another.unwrap().unwrap()[0];
    install(another, &own(another, "small"), there.path()).unwrap();
    let error = install(&made[1], &own(&made[1], "fusing"), there.path())
        .unwrap_err()
        .to_string();
    assert!(
        error.contains("small.safetensors") && error.contains("learned behind"),
        "{error}"
    );
    assert!(!there.path().join("fusing.safetensors").exists());
}
