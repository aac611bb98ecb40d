//! `realo-lab quantize`: a model file for networks of bytes.

use std::ops::Range;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use eyre::Result;
use realo_cli::find::model as find_model;
use realo_cli::{Outcome, Progress};
use realo_training::data::{Frame, Frames, LeftOut, LoggedData, left_out_once};
use realo_training::{Data, FRAMES_APART, MAX_GAP_MS, TrainError, frames, quantize, validation_frames};

use crate::train::{print_left_out, scores, seeds, ways};

/// Finds what bytes stand for in each layer, on simulated frames or logs; says how much AP they cost
#[derive(clap::Args)]
pub struct Args {
    /// The model file, or the name of a shipped one; `NAME-int8.toml` is written beside it
    #[arg(default_value = "lite")]
    model: PathBuf,
    /// Logs with ground truth whose sweeps are looked at, instead of simulator seeds
    #[arg(long, conflicts_with = "seeds")]
    log: Vec<PathBuf>,
    /// Simulator seeds whose sweeps are looked at, first..end
    #[arg(long, default_value = "0..24", value_parser = seeds)]
    seeds: Range<u64>,
    /// Logs with ground truth on which AP is measured [default: simulator seeds 800..812]
    #[arg(long)]
    validation_log: Vec<PathBuf>,
    /// Longest gap between an agent's poses in a log that is bridged, ms, as `max_gap_ms` of the operator `sync`
    #[arg(long, default_value_t = MAX_GAP_MS)]
    max_gap_ms: u32,
    /// Folder of the frames; what is missing is made
    #[arg(long, default_value = "target/realo/frames")]
    cache: PathBuf,
    /// Replace the file if it is there
    #[arg(long)]
    force: bool,
}

/// Quantises and says what it cost.
pub fn main(args: &Args) -> Result<Outcome> {
    let cache = &args.cache;
    let logged = |logs: &[PathBuf]| Data::Logged {
        cache: cache.clone(),
        logged: LoggedData {
            logs: logs.to_vec(),
            apart: FRAMES_APART,
            max_gap_ms: args.max_gap_ms,
        },
    };
    let simulated = Data::Simulated {
        cache: cache.clone(),
        seeds: args.seeds.clone(),
        per_seed: 1,
    };
    let data = if args.log.is_empty() {
        simulated
    } else {
        logged(&args.log)
    };
    let validation = match args.validation_log.is_empty() {
        true => validation_frames(&data)?,
        false => frames(&logged(&args.validation_log))?,
    };
    let frames = frames(&data)?;
    print_left_out(&left_out_once(&*frames, &*validation));
    // Both networks are scored on the frames of the validation.
    let all = frames.len() + 2 * validation.len();
    let work = Arc::new(Work {
        progress: Progress::new("quantising", "frames", Some(all as f64)),
        begun: AtomicUsize::new(0),
    });
    let watched = |frames| -> Arc<dyn Frames> {
        Arc::new(Watched {
            frames,
            work: work.clone(),
        })
    };
    let quantized = quantize(
        &find_model(&args.model)?,
        args.force,
        &watched(frames),
        &watched(validation),
    )?;
    drop(work);
    println!("{} from {} sweeps", quantized.file.display(), quantized.sweeps);
    println!("f32:  {}", scores(&quantized.before));
    println!("int8: {}\n{}", scores(&quantized.after), ways(&quantized.after));
    Ok(Outcome::Complete)
}

/// How many frames were looked at.
struct Work {
    progress: Progress,
    begun: AtomicUsize,
}

/// Frames that count how often they are loaded.
struct Watched {
    frames: Arc<dyn Frames>,
    work: Arc<Work>,
}

impl Frames for Watched {
    fn len(&self) -> usize {
        self.frames.len()
    }

    fn load(&self, index: usize) -> Result<Frame, TrainError> {
        // Those before it are done.
        let done = self.work.begun.fetch_add(1, Ordering::Relaxed);
        self.work.progress.set(done as f64);
        self.frames.load(index)
    }

    fn left_out(&self) -> &[LeftOut] {
        self.frames.left_out()
    }
}
