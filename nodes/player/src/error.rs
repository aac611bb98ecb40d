use std::path::PathBuf;

/// Why a player does not play.
#[derive(Debug, thiserror::Error)]
pub enum PlayerError {
    /// Wall time has one rate, and messages come when they were ready.
    #[error(
        "setting `clock`: with clock=wall, expected `rate` 1 and not `offline`, found rate {rate}, offline {offline}: leave them, or clock=log"
    )]
    Wall {
        /// The rate.
        rate: f64,
        /// Whether it is offline.
        offline: bool,
    },
    /// A clock that is off where no clock is played.
    #[error("setting `skew_ms`: expected 0 without clock=wall, found {0}")]
    Skew(f64),
    /// Packets of a second pass.
    #[error("setting `precomputed`: packets say their own number and time, so that `repeat` must be 1, found {0}")]
    Repeat(u32),
    /// Packets at other times than their own.
    #[error(
        "setting `precomputed`: packets were made with poses and at times as recorded, which `offline` does not play: leave one of \
         the two"
    )]
    Offline,
    /// No file.
    #[error(
        "there is no log `{}`; make one with `realo-lab simulate --scenario intersection --seed 1 --seconds 10 -o {}`",
        .0.display(), realo_logs::shell::word(.0)
    )]
    NoLog(PathBuf),
    /// Nothing in the file.
    #[error("`{}` has no messages", .0.display())]
    Empty(PathBuf),
    /// A start behind the end.
    #[error("setting `start`: expected less than the {length:.3} s of the log, found {start}")]
    Start {
        /// The start, s.
        start: f64,
        /// The log's length, s.
        length: f64,
    },
    /// The plan has no run.
    #[error("a plan has at least one run")]
    NoRun,
    /// A bug of the thread that reads ahead.
    #[error("the thread that reads ahead has stopped")]
    Stopped,
}
