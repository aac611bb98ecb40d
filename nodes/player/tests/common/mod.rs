//! What tests of the player share.

use std::path::Path;

use realo_operator::{Source, StageOutputs};
use realo_player::{Output, Player, Settings};
use realo_schemas::{Message, Nanos};

/// What each port sent, and when.
pub type Played = Vec<(Nanos, &'static str, Message)>;

/// All that a player sends.
pub fn play(config: Settings) -> (Played, Player) {
    let mut player = Player::new(config).unwrap();
    let mut played = Vec::new();
    while let Some((time, output)) = player.next().unwrap() {
        let (port, message) = output.into_message();
        played.push((time, Output::PORTS[port.0].name, message));
    }
    assert!(player.next().unwrap().is_none());
    (played, player)
}

/// Everything as usual.
pub fn config(log: &Path) -> Settings {
    Settings {
        log: log.into(),
        ..Settings::default()
    }
}

/// What one port sent.
pub fn on<'a>(played: &'a Played, port: &str) -> Vec<&'a Message> {
    played
        .iter()
        .filter(|(_, name, _)| *name == port)
        .map(|(_, _, message)| message)
        .collect()
}
