//! The tensors of the messages: their names and shapes.

use realo_nn::tensors::{Role, Specs, TensorSpec};

/// Key of the fusion.
pub const NET: &str = "fusion_net";
/// Key of its gated unit.
pub const UNIT: &str = "fusion_net.conv_gru.cell_list.0";

/// The tensors on maps of so many channels, in the order of the state dict.
pub fn tensors(channels: usize) -> Vec<TensorSpec> {
    let mut all = Specs::default();
    let parts = [
        (format!("{NET}.msg_cnn"), 2 * channels, channels),
        (format!("{UNIT}.conv_gates"), 3 * channels, 2 * channels),
        (format!("{UNIT}.conv_can"), 3 * channels, channels),
    ];
    for (key, inputs, outputs) in parts {
        all.weight(&format!("{key}.weight"), vec![outputs, inputs, 3, 3], 9 * inputs);
        all.push(format!("{key}.bias"), vec![outputs], Role::Bias);
    }
    all.linear(&format!("{NET}.mlp"), channels, channels, true);
    all.0
}
