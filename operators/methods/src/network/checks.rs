//! Whether maps are those of a model.

use realo_kernels::agents::Agent;
use realo_kernels::bev::{BevMap, BevView};
use realo_kernels::conv::View;
use realo_nn::layers::MapSize;

use super::error::NetworkError;

/// A map of a size.
pub(super) fn map_of([rows, columns, channels]: MapSize, data: Vec<f32>) -> BevMap {
    BevMap {
        rows,
        columns,
        channels,
        data,
    }
}

/// A map without a border, if it is of the expected size and has as many numbers.
pub(super) fn plain<'a>(model: &str, map: BevView<'a>, expected: MapSize) -> Result<View<'a, f32>, NetworkError> {
    check_map(model, map, expected)?;
    Ok(View {
        rows: map.rows,
        columns: map.columns,
        stored: map.channels,
        border: 0,
        data: map.data,
        written: None,
    })
}

/// Whether a model of this name, which fuses `most` agents, fuses so many.
///
/// # Errors
/// [`NetworkError::Agents`] if it does not.
pub fn check_agents(model: &str, found: usize, most: usize) -> Result<(), NetworkError> {
    match (1..=most).contains(&found) {
        true => Ok(()),
        false => Err(NetworkError::Agents {
            model: model.into(),
            most,
            found,
        }),
    }
}

/// Whether a BEV map is of the size that a model of this name expects, and has as many numbers.
///
/// # Errors
/// [`NetworkError::Shape`] and [`NetworkError::Length`].
pub fn check_map(model: &str, map: BevView, expected: MapSize) -> Result<(), NetworkError> {
    check_size("the BEV map", model, [map.rows, map.columns, map.channels], expected)?;
    let numbers = expected.iter().product();
    match numbers == map.data.len() {
        true => Ok(()),
        false => Err(NetworkError::Length {
            what: "the BEV map",
            expected: numbers,
            found: map.data.len(),
        }),
    }
}

/// Whether an agent reports its confidence of as many cells as its map has, if it does.
///
/// # Errors
/// [`NetworkError::Length`] if it does not.
pub fn check_confidence(agent: &Agent) -> Result<(), NetworkError> {
    let cells = agent.map.rows * agent.map.columns;
    match agent.confidence {
        Some(confidence) if confidence.len() != cells => Err(NetworkError::Length {
            what: "the confidence of a BEV map",
            expected: cells,
            found: confidence.len(),
        }),
        _ => Ok(()),
    }
}

/// Whether a map is of the size that a model of this name expects.
///
/// # Errors
/// [`NetworkError::Shape`] if it is not.
pub fn check_size(what: &'static str, model: &str, found: MapSize, expected: MapSize) -> Result<(), NetworkError> {
    if found == expected {
        return Ok(());
    }
    Err(NetworkError::Shape {
        what,
        model: model.into(),
        expected,
        found,
    })
}
