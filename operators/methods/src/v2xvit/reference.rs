//! The settings as the reference's configurations write them.

use realo_nn::model::Sharing;
use serde_json::Value;

use super::settings::{Settings, Window};

/// A list of whole numbers of a configuration.
///
/// # Errors
/// If it is none.
pub fn numbers_of(value: &Value) -> Result<Vec<usize>, String> {
    serde_json::from_value(value.clone()).map_err(|error| format!("config of the transformer: {error}"))
}

/// The settings of a transformer.
///
/// # Errors
/// What is missing or of another type.
pub fn settings_of(config: &Value, sharing: Sharing) -> Result<Settings, String> {
    let number = |value: &Value| numbers_of(&Value::Array(vec![value.clone()])).map(|list| list[0]);
    let (over_agents, over_windows) = (&config["cav_att_config"], &config["pwindow_att_config"]);
    let sides = numbers_of(&over_windows["window_size"])?.into_iter();
    let windows = sides
        .zip(numbers_of(&over_windows["heads"])?)
        .zip(numbers_of(&over_windows["dim_head"])?);
    let windows = windows.map(|((side, heads), head_width)| Window {
        side,
        heads,
        head_width,
    });
    Ok(Settings {
        agents: sharing.agents,
        compression: sharing.compression,
        compress_own: sharing.compress_own,
        depth: number(&config["depth"])?,
        blocks: number(&config["num_blocks"])?,
        heads: number(&over_agents["heads"])?,
        head_width: number(&over_agents["dim_head"])?,
        windows: windows.collect(),
        feed_forward: number(&config["feed_forward"]["mlp_dim"])?,
        delay_ratio: number(&config["RTE_ratio"])?,
        ..Settings::default()
    })
}
