//! How samples are changed.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};
use realo_nn::model::Model;
use serde::{Deserialize, Serialize};

use crate::fusing::learns_to_fuse;
use crate::random::Stream;

/// How samples are drawn and changed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Augmentation {
    /// Probability that the ego is a roadside unit.
    pub roadside_ego: f64,
    /// Probability that the ego is alone.
    pub alone: f64,
    /// Probability that everybody within 70 m takes part; else everybody does by a coin of his own.
    pub everybody: f64,
    /// Largest rotation of what is seen on the whole grid, rad; squares are turned by any angle. At 45 degrees the road,
    /// along which the grid is longest, would leave it after 55 m, at 20 degrees after 115 m.
    pub rotation: f64,
    /// Largest pitch and roll, rad.
    pub tilt: f64,
    /// Largest rise and fall, m.
    pub lift: f64,
    /// Probability that what is seen is neither tilted nor lifted: frames are levelled before they reach a network, and from afar
    /// their heights alone tell vans from cars.
    pub level: f64,
    /// Min and max scale.
    pub scale: [f64; 2],
    /// Min and max factor of each object's length, width and height, with its points; recorded sizes are others than ours.
    pub resize: [f64; 2],
    /// Probability that a far object has more background around it, if the ego is a vehicle.
    pub crowd: f64,
    /// Probability that far objects have none around them, if the ego is a roadside unit.
    pub clear: f64,
    /// Probability of mirroring left and right, and front and rear.
    pub mirror: f64,
    /// Probability that an agent's beams are dropped: three of four, every second, or any by chance.
    pub drop_beams: f64,
    /// Probability that points are dropped.
    pub drop: f64,
    /// Smallest share of points that is kept then.
    pub keep: f64,
    /// Decoys that a sample has at most: background that looked like an object when the network was last validated.
    pub decoys: usize,
    /// Deviations of a collaborator's position (m) and heading (rad), as two independent GNSS/INS have.
    pub pose_noise: [f64; 2],
}

impl Default for Augmentation {
    fn default() -> Self {
        Augmentation {
            roadside_ego: 0.33,
            alone: 0.5,
            everybody: 0.3,
            rotation: 20f64.to_radians(),
            tilt: 1.5f64.to_radians(),
            lift: 0.3,
            level: 0.5,
            scale: [0.95, 1.05],
            resize: [0.94, 1.1],
            crowd: 0.75,
            clear: 0.5,
            mirror: 0.5,
            drop_beams: 0.5,
            drop: 0.3,
            keep: 0.5,
            decoys: 3,
            pose_noise: [0.03, 0.002],
        }
    }
}

impl Augmentation {
    /// Frames as they are.
    pub fn none() -> Self {
        Augmentation {
            rotation: 0.0,
            tilt: 0.0,
            lift: 0.0,
            level: 1.0,
            scale: [1.0, 1.0],
            resize: [1.0, 1.0],
            crowd: 0.0,
            clear: 0.0,
            mirror: 0.0,
            drop_beams: 0.0,
            drop: 0.0,
            keep: 1.0,
            decoys: 0,
            pose_noise: [0.0; 2],
            ..Augmentation::default()
        }
    }

    /// What a model needs.
    pub fn of(model: &Model) -> Self {
        match learns_to_fuse(model) {
            true => Augmentation::of_fusion(),
            false => Augmentation::default(),
        }
    }

    /// For a fusion: the others' poses err, and most egos have company.
    pub fn of_fusion() -> Self {
        Augmentation {
            roadside_ego: 0.2,
            alone: 0.1,
            everybody: 0.6,
            pose_noise: Augmentation::default().pose_noise,
            ..Augmentation::none()
        }
    }

    /// How far a collaborator believes itself from where it is, as `true_from_believed`.
    pub(crate) fn pose_error(&self, draws: &mut Stream) -> Isometry3<f64> {
        let [position, heading] = self.pose_noise;
        let off = Vector3::from_fn(|_, _| position * draws.normal());
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading * draws.normal());
        Isometry3::from_parts(off.into(), turn)
    }
}
