//! Writes the world in the layouts of data sets.

use std::fs;
use std::path::Path;

use nalgebra::{Matrix4, Point3};

use crate::world::{Agent, CARS, Car, matrix, mirror};

/// How a set of the family writes.
#[derive(Clone)]
pub struct Style {
    pub left_handed: bool,
    pub digits: usize,
    pub first: u64,
    pub step: u64,
    pub frames: u64,
    pub pose_key: &'static str,
    pub pose_is_matrix: bool,
    pub class_key: Option<&'static str>,
    pub labels_in_lidar: bool,
    /// `pcd` or `bin`.
    pub cloud: &'static str,
    /// Lines before the others in each file of an agent.
    pub head: fn(folder: &str) -> &'static str,
    /// Whether agents label each other, under the name of their folder.
    pub agents_are_objects: bool,
}

pub const OPV2V: Style = Style {
    left_handed: true,
    digits: 6,
    first: 68,
    step: 2,
    frames: 3,
    pose_key: "lidar_pose",
    pose_is_matrix: false,
    class_key: None,
    labels_in_lidar: false,
    cloud: "pcd",
    head: |_| "camera0:\n  cords:\n  - 1.0\n  extrinsic:\n  - - 1.0\n    - 0.0\n",
    agents_are_objects: true,
};

pub const V2X_REAL: Style = Style {
    left_handed: false,
    step: 1,
    first: 30,
    class_key: Some("obj_type"),
    cloud: "bin",
    head: |folder| match folder.starts_with('-') {
        true => "cam1: {}\ninfra: true\n",
        false => "cam1: {}\nego_speed: 0\ntrue_ego_pose: [9, 9, 9, 0, 0, 0]\n",
    },
    agents_are_objects: false,
    ..OPV2V
};

pub const V2V4REAL: Style = Style {
    left_handed: false,
    step: 1,
    first: 0,
    pose_is_matrix: true,
    class_key: Some("obj_type"),
    labels_in_lidar: true,
    head: |_| "",
    agents_are_objects: false,
    ..OPV2V
};

pub const COOPERSCENE: Style = Style {
    digits: 5,
    step: 1,
    first: 12,
    class_key: Some("obj_type"),
    head: |_| "takes: !!python/tuple [1, 2]\n",
    agents_are_objects: false,
    ..OPV2V
};

impl Style {
    /// Writes a scene.
    pub fn write(&self, scene: &Path, agents: &[Agent]) {
        for (number, agent) in agents.iter().enumerate() {
            for frame in 0..self.frames {
                let name = format!("{:0digits$}", self.first + frame * self.step, digits = self.digits);
                let folder = scene.join(agent.folder);
                write(
                    &folder.join(format!("{name}.yaml")),
                    self.labels(agent, frame, agents).as_bytes(),
                );
                let points = self.points(agent, frame, number);
                let bytes = if self.cloud == "bin" {
                    rows(&points)
                } else {
                    pcd(&points)
                };
                write(&folder.join(format!("{name}.{}", self.cloud)), &bytes);
            }
        }
    }

    /// A place of the map in the world of the set.
    fn six(&self, [x, y, z, roll, yaw, pitch]: [f64; 6]) -> [f64; 6] {
        match self.left_handed {
            // Angles about x and z change their sign with y.
            true => [x, -y, z, -roll, -yaw, pitch],
            false => [x, y, z, roll, yaw, pitch],
        }
    }

    fn hand(&self) -> Matrix4<f64> {
        if self.left_handed {
            mirror()
        } else {
            Matrix4::identity()
        }
    }

    /// Points of an agent in the frame of its LiDAR.
    pub fn points(&self, agent: &Agent, frame: u64, number: usize) -> Vec<[f32; 3]> {
        let lidar_from_world = matrix(self.six(agent.at(frame))).try_inverse().unwrap();
        let to_lidar = |point: &Point3<f64>| {
            let point = (lidar_from_world * self.hand()).transform_point(point);
            [point.x as f32, point.y as f32, point.z as f32]
        };
        agent.sees(frame, number).iter().map(to_lidar).collect()
    }

    fn labels(&self, agent: &Agent, frame: u64, agents: &[Agent]) -> String {
        let six = self.six(agent.at(frame));
        let mut text = (self.head)(agent.folder).to_string();
        let numbers: Vec<String> = match self.pose_is_matrix {
            true => matrix(six)
                .transpose()
                .as_slice()
                .chunks(4)
                .map(|row| format!("- {row:?}"))
                .collect(),
            false => six.iter().map(|number| format!("- {number:?}")).collect(),
        };
        text += &format!("{}:\n{}\n", self.pose_key, numbers.join("\n"));
        text += "predicted_ego_pos: [1, 2, 3, 4, 5, 6]\n";
        let cars: Vec<Car> = agent
            .labels
            .iter()
            .map(|id| *CARS.iter().find(|car| car.id == *id).unwrap())
            .collect();
        let others = agents
            .iter()
            .filter(|other| self.agents_are_objects && other.folder != agent.folder);
        let others = others.map(|other| {
            let [x, y, _, _, yaw, _] = other.at(frame);
            Car {
                id: other.folder.trim_start_matches('-').parse().unwrap(),
                center: [x, y, 1.0],
                yaw,
                size: [4.4, 1.8, 1.5],
            }
        });
        let objects: Vec<String> = cars
            .into_iter()
            .chain(others)
            .map(|car| self.object(&car, six))
            .collect();
        match objects.is_empty() {
            true => text + "vehicles: {}\n",
            false => text + "vehicles:\n" + &objects.concat(),
        }
    }

    fn object(&self, car: &Car, lidar: [f64; 6]) -> String {
        let [x, y, z] = car.center;
        let [_, _, _, _, yaw, _] = self.six([x, y, z, 0.0, car.yaw, 0.0]);
        let center = [0.1, 0.0, 0.25];
        // The location is where the middle of the box is not.
        let mut pose = self.hand() * car.pose() * self.hand();
        let mut angle = [0.0, yaw, 0.0];
        if self.labels_in_lidar {
            pose = matrix(lidar).try_inverse().unwrap() * pose;
            angle[1] -= lidar[4];
        }
        let location = pose.transform_point(&Point3::new(-center[0], -center[1], -center[2]));
        let location = [location.x, location.y, location.z];
        let half = car.size.map(|metres| metres / 2.0);
        let class = self.class_key.map_or(String::new(), |key| format!("    {key}: Van\n"));
        let joined = if self.labels_in_lidar {
            format!("    ass_id: {}\n", car.id)
        } else {
            String::new()
        };
        let id = if self.labels_in_lidar {
            car.id + (lidar[0].abs() as u64)
        } else {
            car.id
        };
        format!(
            "  {id}:\n    angle: {angle:?}\n{joined}    center: {center:?}\n    color: 0, 0, 0\n    extent: {half:?}\n    \
             location: {location:?}\n{class}    speed: 36.0\n"
        )
    }
}

pub fn write(path: &Path, bytes: &[u8]) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, bytes).unwrap();
}

/// A binary cloud whose intensities are half of 1.
pub fn pcd(points: &[[f32; 3]]) -> Vec<u8> {
    let n = points.len();
    let mut file = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    .into_bytes();
    file.extend(rows(points));
    file
}

/// Rows of x, y, z and intensity, half of 1 but the last.
pub fn rows(points: &[[f32; 3]]) -> Vec<u8> {
    let intensity = |index: usize| if index + 1 == points.len() { 1.0 } else { 0.5_f32 };
    let row = |(index, [x, y, z]): (usize, &[f32; 3])| [*x, *y, *z, intensity(index)].map(f32::to_le_bytes).concat();
    points.iter().enumerate().flat_map(row).collect()
}
