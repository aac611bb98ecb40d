//! Training as a whole, on a small network.

use std::collections::BTreeMap;
use std::fs;
use std::ops::ControlFlow;
use std::os::unix::fs::symlink;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use realo_methods::Model;
use realo_nn::weights::Weights;
use realo_training::data::Augmentation;
use realo_training::optimizer::OptimizerSettings;
use realo_training::{Data, News, Part, TrainError, TrainOptions, Validation, train, train_with};
use safetensors::SafeTensors;

/// A small detector.
const MODEL: &str = include_str!("small.toml");

/// A fusion behind the small model's encoder.
const FUSING: &str = r#"
extends = "small.toml"
name = "fusing"
[arch]
kind = "v2xvit"
heads = 2
head_width = 6
windows = [{ side = 2, heads = 2, head_width = 6 }, { side = 8, heads = 1, head_width = 4 }]
feed_forward = 12
"#;

/// Frames that all tests share.
fn cache() -> &'static Path {
    static CACHE: OnceLock<tempfile::TempDir> = OnceLock::new();
    CACHE.get_or_init(|| tempfile::tempdir().unwrap()).path()
}

struct Folder {
    folder: tempfile::TempDir,
}

impl Folder {
    fn new() -> Self {
        Folder {
            folder: tempfile::tempdir().unwrap(),
        }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn options(&self, second_class: &str, output: &str) -> TrainOptions {
        let model = self.path("small.toml");
        fs::write(&model, MODEL.replace("truck", second_class)).unwrap();
        TrainOptions {
            model,
            from: None,
            teacher: None,
            output: self.path(output),
            resume: false,
            data: Data::Simulated {
                cache: cache().into(),
                seeds: 0..2,
                per_seed: 1,
            },
            steps: 6,
            minutes: None,
            fit_steps: false,
            seed: 3,
            batch: 2,
            freeze: Vec::new(),
            frozen_norms: false,
            parts: 0.5,
            checkpoint_minutes: 0.0,
            validate_every: None,
            compare: false,
            validation: None,
            optimizer: OptimizerSettings {
                rate: 2e-3,
                ..OptimizerSettings::default()
            },
            augmentation: Augmentation::default(),
            threads: Some(2),
            arithmetic: None,
        }
    }
}

/// All tensors of a file but the times in the curve.
fn bits(path: &Path) -> BTreeMap<String, Vec<u8>> {
    let bytes = fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let tensors = file.iter().filter(|(name, _)| *name != "curve");
    tensors
        .map(|(name, view)| (name.to_string(), view.data().to_vec()))
        .collect()
}

#[test]
fn frozen_norms_keep_the_statistics_that_they_begin_with() {
    let folder = Folder::new();
    let first = folder.options("truck", "first");
    train(&first, |_| ()).unwrap();
    let after = |output: &str, frozen_norms: bool| {
        let options = TrainOptions {
            from: Some(folder.path("first/small.toml")),
            frozen_norms,
            ..folder.options("truck", output)
        };
        train(&options, |_| ()).unwrap();
        let kept = bits(&folder.path("first/small.safetensors"));
        let moved = bits(&folder.path(&format!("{output}/small.safetensors")));
        let (statistics, others): (Vec<_>, Vec<_>) = moved
            .into_iter()
            .map(|(name, bits)| (name.contains("running_"), kept[&name] == bits))
            .partition(|(is_statistics, _)| *is_statistics);
        [statistics, others].map(|all| all.iter().filter(|(_, same)| *same).count() as f64 / all.len() as f64)
    };
    assert_eq!(after("frozen", true), [1.0, 0.0]);
    assert_eq!(after("moving", false), [0.0, 0.0]);
    let random = TrainOptions {
        frozen_norms: true,
        ..folder.options("truck", "random")
    };
    let refused = train(&random, |_| ()).unwrap_err().to_string();
    assert!(refused.contains("frozen_norms"), "{refused}");
}

#[test]
fn a_fusion_learns_from_a_teacher_and_a_resumed_one_needs_the_same() {
    let folder = Folder::new();
    train(&folder.options("truck", "teacher"), |_| ()).unwrap();
    let fusing = folder.path("fusing.toml");
    fs::write(
        &fusing,
        "extends = \"small.toml\"\nname = \"fusing\"\n[arch]\nkind = \"attfuse\"\n",
    )
    .unwrap();
    let taught = TrainOptions {
        model: fusing,
        teacher: Some(folder.path("teacher/small.toml")),
        augmentation: Augmentation::of_fusion(),
        steps: 24,
        ..folder.options("truck", "taught")
    };
    let mut lessons = Vec::new();
    train(&taught, |far| lessons.push(far.point.lesson)).unwrap();
    let mean = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
    assert!(mean(&lessons[16..]) < 0.9 * mean(&lessons[..8]), "{lessons:?}");
    let without = TrainOptions {
        teacher: None,
        resume: true,
        ..taught.clone()
    };
    let error = train(&without, |_| ()).unwrap_err().to_string();
    assert!(error.contains("teacher: was"), "{error}");
    let wide = folder.path("wide.toml");
    fs::write(&wide, MODEL.replace("cell = 0.8", "cell = 0.4")).unwrap();
    assert!(MODEL.contains("cell = 0.8"));
    let wrong = TrainOptions {
        model: wide,
        output: folder.path("wrong"),
        ..taught
    };
    let error = train(&wrong, |_| ()).unwrap_err().to_string();
    assert!(error.contains("cell of the map that the heads read"), "{error}");
}

#[test]
fn a_training_begins_with_the_weights_of_a_narrower_network() {
    let folder = Folder::new();
    train(&folder.options("truck", "narrow"), |_| ()).unwrap();
    let from = Some(folder.path("narrow/small.toml"));
    let wider = |name: &str, from_text: &str, to: &str| {
        let model = folder.path(&format!("{name}.toml"));
        let text = MODEL.replace("name = \"small\"", &format!("name = \"{name}\""));
        assert!(text.contains(from_text));
        fs::write(&model, text.replace(from_text, to)).unwrap();
        TrainOptions {
            model,
            from: from.clone(),
            ..folder.options("truck", name)
        }
    };
    let wide = wider("wide", "channels = [8, 16]", "channels = [12, 24]");
    assert!(train(&wide, |_| ()).unwrap().complete);
    let less = train(&wider("less", "channels = [8, 16]", "channels = [8, 12]"), |_| ()).unwrap_err();
    assert!(
        less.to_string().contains("channels: expected [8,12], found [8,16]"),
        "{less}"
    );
}

#[test]
fn a_killed_training_goes_on_to_the_same_bits() {
    let folder = Folder::new();
    let whole = folder.options("truck", "whole");
    assert!(train(&whole, |_| ()).unwrap().complete);
    let mut parts = folder.options("truck", "parts");
    let killed = catch_unwind(AssertUnwindSafe(|| {
        train(&parts, |progress| assert!(progress.point.step < 3))
    }));
    assert!(killed.is_err());
    assert!(
        matches!(train(&parts, |_| ()), Err(TrainError::Checkpoint { .. })),
        "it must not start anew by itself"
    );
    parts.resume = true;
    // The number of threads does not matter either.
    parts.threads = Some(1);
    let mut steps = Vec::new();
    assert!(
        train(&parts, |progress| steps.push(progress.point.step))
            .unwrap()
            .complete
    );
    assert_eq!(steps, [3, 4, 5]);
    for name in ["checkpoint.safetensors", "small.safetensors"] {
        assert!(
            bits(&whole.output.join(name)) == bits(&parts.output.join(name)),
            "{name} differs"
        );
    }
    let csv = fs::read_to_string(parts.output.join("curve.csv")).unwrap();
    assert_eq!(csv.lines().count(), 7);
    assert!(
        fs::read_to_string(parts.output.join("curve.svg"))
            .unwrap()
            .contains("<polyline")
    );
    let model = Model::read(&parts.model).unwrap();
    Weights::read(&[parts.output.join("small.safetensors")], &model).unwrap();
}

#[test]
fn the_loss_falls() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    (options.steps, options.checkpoint_minutes, options.parts) = (150, 1.0, 0.0);
    options.optimizer.rate = 1e-2;
    options.augmentation = Augmentation {
        alone: 0.0,
        everybody: 1.0,
        ..Augmentation::none()
    };
    let mut losses = Vec::new();
    train(&options, |progress| losses.push(progress.point.loss())).unwrap();
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (before, after) = (mean(&losses[..10]), mean(&losses[140..]));
    assert!(after < 0.5 * before, "from {before} to {after}");
}

#[test]
fn a_time_budget_ends_early_and_a_resume_goes_on() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    options.minutes = Some(1e-6);
    let first = train(&options, |_| ()).unwrap();
    assert!(!first.complete && first.steps < 6);
    (options.minutes, options.resume) = (None, true);
    assert!(train(&options, |_| ()).unwrap().complete);
}

#[test]
fn steps_fitted_into_a_time_end_with_a_validation() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    (options.minutes, options.fit_steps, options.compare) = (Some(0.05), true, true);
    let mut steps = Vec::new();
    let trained = train(&options, |progress| steps.push(progress.point.step)).unwrap();
    assert!(trained.complete && trained.steps <= trained.of_steps, "{trained:?}");
    assert_eq!(steps, (0..trained.steps).collect::<Vec<u64>>());
    let comparison = trained.comparison.expect("a validation");
    assert_eq!(comparison.frames, "simulator seeds 800 to 811");
    assert!(comparison.before.is_none(), "it began with random numbers");
    options.minutes = None;
    assert!(train(&options, |_| ()).is_err());
}

#[test]
fn the_weights_of_from_are_scored_on_the_frames_of_the_last_validation() {
    let folder = Folder::new();
    train(&folder.options("truck", "first"), |_| ()).unwrap();
    let mut second = TrainOptions {
        from: Some(folder.path("first/small.toml")),
        compare: true,
        steps: 2,
        ..folder.options("truck", "second")
    };
    second.minutes = Some(1e-6);
    let cut = train(&second, |_| ()).unwrap();
    assert!(!cut.complete && cut.comparison.is_none(), "{cut:?}");
    (second.minutes, second.resume) = (None, true);
    let found = train(&second, |_| ()).unwrap().comparison.expect("a validation");
    let before = found.before.expect("weights to begin with");
    assert!(before.begins);
    assert_eq!((before.score.frames, found.after.frames), (12, 12));
    let names = |of: &Validation| of.classes.iter().map(|class| class.name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&before.score), names(&found.after));
    let of_start = TrainOptions {
        resume: false,
        steps: 1,
        output: folder.path("third"),
        ..second
    };
    let again = train(&of_start, |_| ()).unwrap().comparison.expect("a validation");
    assert_eq!(again.before, Some(before), "resumed or not");
}

#[test]
fn weights_beside_the_model_file_are_scored_before_the_first_step_where_they_are_not_begun_with() {
    let folder = Folder::new();
    train(&folder.options("truck", "first"), |_| ()).unwrap();
    let again = TrainOptions {
        model: folder.path("first/small.toml"),
        compare: true,
        steps: 2,
        ..folder.options("truck", "second")
    };
    let mut news = Vec::new();
    let trained = train_with(&again, |said| {
        news.push(match said {
            News::Before(before) => Some((*before).clone()),
            _ => None,
        });
        ControlFlow::Continue(())
    });
    let before = trained.unwrap().comparison.and_then(|found| found.before);
    assert!(before.as_ref().is_some_and(|before| !before.begins), "{before:?}");
    assert_eq!(news, [before, None, None]);
}

#[test]
fn a_training_that_is_ended_after_a_step_goes_on_where_it_was() {
    let folder = Folder::new();
    for fit_steps in [false, true] {
        let out = format!("ended-{fit_steps}");
        let options = TrainOptions {
            fit_steps,
            minutes: fit_steps.then_some(0.05),
            ..folder.options("truck", &out)
        };
        let ended = train_with(&options, |said| match said {
            News::Step(_) => ControlFlow::Break(()),
            _ => ControlFlow::Continue(()),
        });
        let ended = ended.unwrap();
        assert_eq!(ended.steps, 1, "{ended:?}");
        // Into a time in which the machine does no more, one step is fitted.
        assert_eq!(ended.complete, ended.of_steps == 1, "{ended:?}");
        let again = TrainOptions {
            resume: true,
            ..options
        };
        let mut first = None;
        let trained = train(&again, |far| _ = first.get_or_insert(far.point.step)).unwrap();
        assert!(trained.complete && (first == Some(1) || ended.complete), "{trained:?}");
    }
}

#[test]
fn a_resumed_training_is_not_compared_with_its_own_weights() {
    let folder = Folder::new();
    let first = TrainOptions {
        compare: true,
        minutes: Some(1e-6),
        ..folder.options("truck", "out")
    };
    assert!(!train(&first, |_| ()).unwrap().complete);
    assert!(folder.path("out/small.safetensors").exists());
    let again = TrainOptions {
        model: folder.path("out/small.toml"),
        minutes: None,
        resume: true,
        ..first
    };
    let found = train(&again, |_| ()).unwrap().comparison.expect("a validation");
    assert_eq!(found.before, None);
}

#[test]
fn two_trainings_do_not_share_a_folder() {
    let folder = Folder::new();
    let options = folder.options("truck", "out");
    let second = TrainOptions {
        resume: true,
        ..folder.options("truck", "out")
    };
    let mut refused = Vec::new();
    train(&options, |_| refused.push(train(&second, |_| ()).unwrap_err())).unwrap();
    let busy = |error: &TrainError| matches!(error, TrainError::Busy { .. });
    assert!(refused.len() == 6 && refused.iter().all(busy), "{refused:?}");
    assert!(
        train(&second, |_| ()).unwrap().complete,
        "the lock goes with the training"
    );
}

#[test]
fn a_full_disk_leaves_the_checkpoint_before() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    options.steps = 4;
    let checkpoint = options.output.join("checkpoint.safetensors");
    let part = checkpoint.with_extension("part");
    let mut saved = Vec::new();
    let error = train(&options, |progress| {
        if progress.point.step == 2 {
            saved = fs::read(&checkpoint).unwrap();
            symlink("/dev/full", &part).unwrap();
        }
    })
    .unwrap_err();
    for part in ["No space left on device", "stays as it was", "--resume"] {
        assert!(error.to_string().contains(part), "{part} is not in {error}");
    }
    assert!(!saved.is_empty() && fs::read(&checkpoint).unwrap() == saved);
    options.resume = true;
    assert_eq!(train(&options, |_| ()).unwrap().steps, 4);
}

#[test]
fn a_training_in_which_nothing_is_learnt_is_refused() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    options.freeze = vec![Part::Encoder, Part::Fusion, Part::Heads];
    let error = train(&options, |_| ()).unwrap_err().to_string();
    assert!(
        error.contains("`freeze`: expected parts that leave something to learn, found encoder, fusion, heads"),
        "{error}"
    );
    assert!(!options.output.exists());
}

#[test]
fn a_loss_that_is_no_number_ends_the_training_and_saves_nothing() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    let killed = catch_unwind(AssertUnwindSafe(|| {
        train(&options, |progress| assert!(progress.point.step < 2))
    }));
    assert!(killed.is_err());
    let checkpoint = options.output.join("checkpoint.safetensors");
    let saved = fs::read(&checkpoint).unwrap();
    (options.resume, options.optimizer.rate) = (true, 1e30);
    let error = train(&options, |_| ()).unwrap_err();
    assert!(matches!(error, TrainError::Diverged { saved: true, .. }), "{error}");
    assert!(error.to_string().contains("--resume goes on from it"), "{error}");
    assert!(
        fs::read(&checkpoint).unwrap() == saved,
        "the step that went too far is not kept"
    );
    options.optimizer.rate = 1e-3;
    assert!(train(&options, |_| ()).unwrap().complete);
    let weights = fs::read(options.output.join("small.safetensors")).unwrap();
    let weights = SafeTensors::deserialize(&weights).unwrap();
    let small = |bytes: &[u8]| {
        let mut values = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b));
        values.all(|value| value.abs() < 100.0)
    };
    assert!(weights.iter().all(|(_, view)| small(view.data())));
}

#[test]
fn a_class_that_the_data_lack_is_named() {
    let folder = Folder::new();
    let error = train(&folder.options("tram", "out"), |_| ()).unwrap_err();
    assert!(
        matches!(&error, TrainError::AbsentClass { class, .. } if class == "tram"),
        "{error}"
    );
}

#[test]
fn a_checkpoint_of_another_plan_is_refused() {
    let folder = Folder::new();
    let mut options = folder.options("truck", "out");
    options.steps = 1;
    train(&options, |_| ()).unwrap();
    (options.resume, options.batch) = (true, 3);
    let error = train(&options, |_| ()).unwrap_err().to_string();
    assert!(error.contains("batch: was 2, now 3 is asked for"), "{error}");
    options.batch = 2;
    let text = fs::read_to_string(&options.model).unwrap();
    fs::write(&options.model, text.replace("matched = 0.6", "matched = 0.7")).unwrap();
    let error = train(&options, |_| ()).unwrap_err().to_string();
    assert!(error.contains("model.classes"), "{error}");
    let beside = fs::read_to_string(options.output.join("small.toml")).unwrap();
    assert!(
        beside.starts_with(text.trim_end()) && beside.contains("[sha256]"),
        "the weights keep the model file that they were trained by, with their checksum: {beside}"
    );
    fs::write(options.output.join("checkpoint.safetensors"), b"nonsense").unwrap();
    assert!(matches!(train(&options, |_| ()), Err(TrainError::Checkpoint { .. })));
}

#[test]
fn a_training_begins_with_the_weights_that_are_given() {
    let folder = Folder::new();
    let how = Augmentation {
        alone: 0.0,
        everybody: 1.0,
        ..Augmentation::none()
    };
    let first = TrainOptions {
        steps: 60,
        checkpoint_minutes: 1.0,
        parts: 0.0,
        augmentation: how,
        ..folder.options("truck", "first")
    };
    let losses = |options: &TrainOptions| {
        let mut losses = Vec::new();
        train(options, |progress| losses.push(progress.point.loss())).unwrap();
        losses
    };
    let learnt = losses(&first);
    // What only says how objects are laid beside anchors is no reason to refuse weights.
    let written = first.output.join("small.toml");
    let text = fs::read_to_string(&written).unwrap();
    let otherwise = format!(
        "matching = \"turned\"\n{}",
        text.replace("unmatched = 0.45", "unmatched = 0.4")
    );
    assert_eq!(otherwise.matches("unmatched = 0.4 ").count(), 2, "{text}");
    fs::write(&written, otherwise).unwrap();
    let again = TrainOptions {
        output: folder.path("again"),
        from: Some(first.output.join("small.toml")),
        steps: 1,
        ..first.clone()
    };
    let begun = losses(&again)[0];
    assert!(begun < 0.7 * learnt[0], "{begun}, random weights {}", learnt[0]);
    let other = TrainOptions {
        from: None,
        resume: true,
        ..again
    };
    let said = train(&other, |_| ()).unwrap_err().to_string();
    assert!(said.contains("from: was \"small-"), "{said}");
}

/// Options for a fusion behind an encoder that was trained for some steps.
fn fusing(folder: &Folder) -> TrainOptions {
    let detector = folder.options("truck", "detector");
    train(&detector, |_| ()).unwrap();
    // The model file lies beside its weights.
    let model = folder.path("fusing.toml");
    fs::write(&model, FUSING).unwrap();
    TrainOptions {
        model,
        from: Some(detector.output.join("small.toml")),
        augmentation: Augmentation::of_fusion(),
        ..folder.options("truck", "fusing")
    }
}

#[test]
fn a_fusion_learns_and_its_encoder_stays_if_it_is_frozen() {
    let folder = Folder::new();
    let mut options = fusing(&folder);
    (options.steps, options.checkpoint_minutes) = (60, 1.0);
    options.freeze = vec![Part::Encoder];
    let mut losses = Vec::new();
    assert!(
        train(&options, |progress| losses.push(progress.point.loss()))
            .unwrap()
            .complete
    );
    let mean = |part: &[f64]| part.iter().sum::<f64>() / part.len() as f64;
    let (before, after) = (mean(&losses[..10]), mean(&losses[50..]));
    assert!(after < 0.8 * before, "from {before} to {after}");
    let encoder = bits(&folder.path("detector/small.safetensors"));
    let trained = bits(&options.output.join("fusing.safetensors"));
    let heads = |name: &str| name.starts_with("cls_head") || name.starts_with("reg_head");
    for (name, numbers) in &encoder {
        assert_eq!(trained[name] == *numbers, !heads(name), "{name}");
    }
    // What the model file extends lies beside it.
    let model = Model::read(&options.output.join("fusing.toml")).unwrap();
    Weights::read(&[options.output.join("fusing.safetensors")], &model).unwrap();
}

#[test]
fn an_encoder_of_another_file_is_not_written_twice() {
    let folder = Folder::new();
    let mut whole = fusing(&folder);
    whole.freeze = vec![Part::Encoder];
    train(&whole, |_| ()).unwrap();
    let apart = TrainOptions {
        output: folder.path("apart"),
        ..whole.clone()
    };
    fs::write(&whole.model, FUSING.replace("[arch]", "encoder = \"small\"\n[arch]")).unwrap();
    train(&apart, |_| ()).unwrap();
    let [of_whole, own, encoder] = [
        whole.output.join("fusing.safetensors"),
        apart.output.join("fusing.safetensors"),
        apart.output.join("small.safetensors"),
    ]
    .map(|path| bits(&path));
    assert!(own.keys().all(|name| !encoder.contains_key(name)) && own.contains_key("cls_head.weight"));
    assert!(of_whole == own.into_iter().chain(encoder).collect());

    let loaded =
        |output: &Path| realo_methods::load(&output.join("fusing.toml"), realo_methods::Kernels::auto(1)).unwrap();
    let same = |key: &(String, Vec<usize>)| {
        loaded(&whole.output).weights.tensor(&key.0) == loaded(&apart.output).weights.tensor(&key.0)
    };
    let keys = realo_nn::weights::expected(&Model::read(&apart.output.join("fusing.toml")).unwrap());
    assert!(keys.iter().all(same));
    fs::write(
        &whole.model,
        FUSING.replace("[arch]", "encoder = \"checkpoint\"\n[arch]"),
    )
    .unwrap();
    let refused = train(&apart, |_| ()).unwrap_err().to_string();
    assert!(refused.contains("`encoder` is `checkpoint`"), "{refused}");
    fs::remove_file(apart.output.join("small.safetensors")).unwrap();
    let error = realo_methods::load(&apart.output.join("fusing.toml"), realo_methods::Kernels::auto(1));
    assert!(error.err().unwrap().to_string().contains("small.safetensors: "));
}

#[test]
fn a_killed_training_of_a_fusion_goes_on_to_the_same_bits() {
    let folder = Folder::new();
    let whole = fusing(&folder);
    assert!(train(&whole, |_| ()).unwrap().complete);
    let mut parts = TrainOptions {
        output: folder.path("parts"),
        ..whole.clone()
    };
    let killed = catch_unwind(AssertUnwindSafe(|| {
        train(&parts, |progress| assert!(progress.point.step < 3))
    }));
    assert!(killed.is_err());
    parts.resume = true;
    assert!(train(&parts, |_| ()).unwrap().complete);
    let [whole, parts] = [whole, parts].map(|options| bits(&options.output.join("checkpoint.safetensors")));
    assert!(whole == parts);
}

#[test]
fn a_fusion_without_an_encoder_that_fits_is_refused() {
    let folder = Folder::new();
    let options = fusing(&folder);
    let refused = |options: &TrainOptions| train(options, |_| ()).unwrap_err().to_string();
    let none = TrainOptions {
        from: None,
        ..options.clone()
    };
    fs::write(&options.model, FUSING.replace("[arch]", "encoder = \"small\"\n[arch]")).unwrap();
    let said = refused(&none);
    assert!(
        said.contains("`from`") && said.contains("--from models/lite.toml"),
        "{said}"
    );
    let text = fs::read_to_string(folder.path("small.toml")).unwrap();
    let narrow = text.replace("channels = [8, 16]", "channels = [8, 12]");
    fs::write(folder.path("small.toml"), narrow).unwrap();
    let said = refused(&options);
    for part in [
        "small.toml`",
        "`fusing`",
        "backbone.channels: expected [8,12], found [8,16]",
    ] {
        assert!(said.contains(part), "{part}: {said}");
    }
}

#[test]
fn encoder_compressor_fusion_and_heads_learn_together() {
    let folder = Folder::new();
    let mut options = fusing(&folder);
    let compressing = FUSING.replace("heads = 2\n", "heads = 2\ncompression = 2\n");
    fs::write(&options.model, compressing).unwrap();
    (options.steps, options.batch) = (3, 1);
    train(&options, |_| ()).unwrap();
    let first = bits(&options.output.join("fusing.safetensors"));
    let model = Model::read(&options.output.join("fusing.toml")).unwrap();
    Weights::read(&[options.output.join("fusing.safetensors")], &model).unwrap();
    let encoder = bits(&folder.path("detector/small.safetensors"));
    assert!(
        encoder.iter().all(|(name, numbers)| first[name] != *numbers),
        "all of the detector moved"
    );
    assert!(first.keys().any(|name| name.contains("compress")), "{:?}", first.keys());
}
