//! The tensors of a transformer: their names and shapes.

use realo_nn::tensors::{Role, Specs, TensorSpec};

use super::settings::Settings;

/// Kinds of agents: vehicles, and roadside units.
pub const KINDS: usize = 2;
/// Key of the whole transformer.
pub const ENCODER: &str = "fusion_net.encoder";
/// Key of an attention over agents: its norm, and under `fn` its layers.
pub fn agents_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.0")
}

/// Key of an attention within windows: its norm, and under `fn` its layers.
pub fn windows_key(depth: usize, block: usize) -> String {
    format!("{ENCODER}.layers.{depth}.0.layers.{block}.1")
}

/// Key of a feed-forward: its norm, and under `fn` its layers.
pub fn forward_key(depth: usize) -> String {
    format!("{ENCODER}.layers.{depth}.1")
}

/// The tensors of a transformer on maps of so many channels, in the order of the state dict.
pub fn tensors(settings: &Settings, channels: usize) -> Vec<TensorSpec> {
    let mut all = Specs::default();
    // Stored by the reference, and never used.
    all.linear(&format!("{ENCODER}.prior_feed"), channels + 3, channels, true);
    for depth in 0..settings.depth {
        for block in 0..settings.blocks {
            add_agents(&mut all, &agents_key(depth, block), settings, channels);
            add_windows(&mut all, &windows_key(depth, block), settings, channels);
        }
        let key = forward_key(depth);
        all.norm(&format!("{key}.norm"), channels);
        all.linear(&format!("{key}.fn.net.0"), channels, settings.feed_forward, true);
        all.linear(&format!("{key}.fn.net.3"), settings.feed_forward, channels, true);
    }
    let key = format!("{ENCODER}.rte.emb");
    all.push(
        format!("{key}.emb.weight"),
        vec![settings.delays, channels],
        Role::Delays,
    );
    all.linear(&format!("{key}.lin"), channels, channels, true);
    all.0
}

fn add_agents(all: &mut Specs, key: &str, settings: &Settings, channels: usize) {
    all.norm(&format!("{key}.norm"), channels);
    let (heads, width) = (settings.heads, settings.head_width);
    for relation in ["relation_att", "relation_msg"] {
        let shape = vec![KINDS * KINDS, heads, width, width];
        all.weight(&format!("{key}.fn.{relation}"), shape, width);
    }
    for part in ["k", "q", "v", "a"] {
        for kind in 0..KINDS {
            all.linear(&format!("{key}.fn.{part}_linears.{kind}"), channels, channels, true);
        }
    }
}

fn add_windows(all: &mut Specs, key: &str, settings: &Settings, channels: usize) {
    all.norm(&format!("{key}.norm"), channels);
    for (index, window) in settings.windows.iter().enumerate() {
        let key = format!("{key}.fn.pwmsa.{index}");
        let side = 2 * window.side - 1;
        all.weight(&format!("{key}.pos_embedding"), vec![side, side], 1);
        all.linear(&format!("{key}.to_qkv"), channels, 3 * window.width(), false);
        all.linear(&format!("{key}.to_out.0"), window.width(), channels, true);
    }
    let key = format!("{key}.fn.split_attn");
    all.linear(&format!("{key}.fc1"), channels, channels, false);
    all.norm(&format!("{key}.bn1"), channels);
    all.linear(
        &format!("{key}.fc2"),
        channels,
        settings.windows.len() * channels,
        false,
    );
}
