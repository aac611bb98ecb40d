//! Scenes that are made up here, written in the layouts of data sets, imported, and read back.

mod bad_input;
mod chosen;
mod forms;
mod kitti;
mod layouts;
mod numpy;
mod radio;
mod reading;
mod round_trip;
mod tumtraf;
mod urbaning;
mod v2x_seq;
mod world;

use world::Agent;

/// Two vehicles and a roadside unit that see the same cars.
pub const AGENTS: [Agent; 3] = [
    Agent {
        folder: "641",
        six: [0.0, 0.0, 1.9, 1.0, 20.0, -0.8],
        step: [0.5, 0.2],
        labels: &[11, 12, 13],
    },
    Agent {
        folder: "650",
        six: [25.0, 3.0, 1.7, -0.5, 200.0, 0.6],
        step: [-0.4, 0.1],
        labels: &[12, 13, 14],
    },
    Agent {
        folder: "-1",
        six: [15.0, -9.0, 4.5, 0.3, 90.0, 0.2],
        step: [0.0, 0.0],
        labels: &[11, 14],
    },
];
