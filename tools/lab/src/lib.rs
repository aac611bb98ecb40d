//! The workbench: it makes logs, weights and measurements for what runs in the car.

pub mod measure;
