//! OPV2V's family: a folder for each agent, with a file of labels beside each cloud.

use std::path::Path;

use realo_logs::AgentKind;
use realo_schemas::Box3;
use realo_schemas::geometry::{transform_box, yaw_of};

use crate::files::{pcd, rows, write};
use crate::scene::{Agent, HEIGHT, Scene, Sweep};

/// How a set of the family writes.
pub struct Style {
    left_handed: bool,
    digits: usize,
    /// `pcd` or `bin`.
    cloud: &'static str,
    pose_is_matrix: bool,
    labels_in_lidar: bool,
    folder: fn(number: usize, kind: AgentKind) -> String,
}

pub const V2X_REAL: Style = Style {
    left_handed: false,
    digits: 6,
    cloud: "bin",
    pose_is_matrix: false,
    labels_in_lidar: false,
    folder: |number, kind| match kind {
        AgentKind::Vehicle => (number + 1).to_string(),
        AgentKind::Roadside => "-1".into(),
    },
};

pub const V2V4REAL: Style = Style {
    cloud: "pcd",
    pose_is_matrix: true,
    labels_in_lidar: true,
    folder: |number, _| number.to_string(),
    ..V2X_REAL
};

pub const COOPERSCENE: Style = Style {
    left_handed: true,
    digits: 5,
    cloud: "pcd",
    folder: |number, kind| match kind {
        AgentKind::Vehicle => (number + 1).to_string(),
        AgentKind::Roadside => "0".into(),
    },
    ..V2X_REAL
};

impl Style {
    pub fn write(&self, scene: &Scene, data: &Path) {
        for (number, Agent { kind, sweeps, .. }) in scene.agents.iter().enumerate() {
            let folder = data.join("test/2023_03_17_15_53_02").join((self.folder)(number, *kind));
            for (frame, sweep) in sweeps.iter().enumerate() {
                let file = |end: &str| folder.join(format!("{frame:0digits$}.{end}", digits = self.digits));
                write(&file("yaml"), self.labels(sweep, *kind).as_bytes());
                let mut points = sweep.in_lidar(HEIGHT);
                points.iter_mut().for_each(|[_, y, _]| *y *= self.hand() as f32);
                let bytes = if self.cloud == "bin" { rows } else { pcd };
                write(&file(self.cloud), &bytes(&points, &sweep.intensities()));
            }
        }
    }

    /// Sign of y and of angles about z: -1 in left-handed sets.
    fn hand(&self) -> f64 {
        if self.left_handed { -1.0 } else { 1.0 }
    }

    fn labels(&self, sweep: &Sweep, kind: AgentKind) -> String {
        let map_from_lidar = sweep.map_from_lidar(HEIGHT);
        let [x, y, z] = map_from_lidar.translation.vector.into();
        let yaw = yaw_of(&map_from_lidar.rotation).to_degrees() * self.hand();
        let pose = match self.pose_is_matrix {
            true => crate::files::matrix(&map_from_lidar).to_string(),
            false => format!("{:?}", [x, y * self.hand(), z, 0.0, yaw, 0.0]),
        };
        let infra = if kind == AgentKind::Roadside {
            "infra: true\n"
        } else {
            ""
        };
        let there = |object: &Box3| match self.labels_in_lidar {
            true => transform_box(&map_from_lidar.inverse(), object),
            false => object.clone(),
        };
        let objects: Vec<String> = sweep
            .labels()
            .iter()
            .map(|object| self.object(&there(object)))
            .collect();
        format!("lidar_pose: {pose}\n{infra}vehicles:\n{}", objects.concat())
    }

    fn object(&self, object: &Box3) -> String {
        let ([x, y, z], half) = (object.center, object.height / 2.0);
        let id = object.track.expect("a track");
        let joined = if self.labels_in_lidar {
            format!("    ass_id: {id}\n")
        } else {
            String::new()
        };
        format!(
            "  {id}:\n{joined}    angle: {:?}\n    center: {:?}\n    extent: {:?}\n    location: {:?}\n    obj_type: {}\n",
            [0.0, object.yaw.to_degrees() * self.hand(), 0.0],
            [0.0, 0.0, half],
            [object.length / 2.0, object.width / 2.0, half],
            [x, y * self.hand(), z - half],
            object.class
        )
    }
}
