//! KITTI: the clouds, labels, calibrations, poses and times of one agent.

mod camera;

use nalgebra::Isometry3;
use realo_logs::Log;
use realo_schemas::{Nanos, to_seconds};

use self::camera::{CALIBRATION, camera_from_lidar, label};
use super::{Exporter, Kind, Report};
use crate::places::number;
use crate::scene::{Scene, Sweep};
use crate::{ExportError, Exported, ExportedAgent, Folder, Options, lost};

/// KITTI.
pub struct Kitti;

static KIND: Kind = Kind {
    name: "kitti",
    title: "KITTI's layout, one agent",
    writes: "velodyne/000000.bin, label_2/000000.txt and calib/000000.txt for each sweep, poses.txt and times.txt",
    unit: "sweeps",
    options: &[("agent", ""), ("classes", ""), ("labels", "truth"), ("height", "")],
};

impl Exporter for Kitti {
    fn kind(&self) -> &'static Kind {
        &KIND
    }

    fn write(
        &self,
        log: &Log,
        folder: &mut Folder,
        options: &Options,
        report: Report,
    ) -> Result<Exported, ExportError> {
        let agents: Vec<&str> = log.info().agents.iter().map(|agent| agent.name.as_str()).collect();
        if options.agents.is_empty() && agents.len() > 1 {
            let reason = format!(
                "--agent: expected one agent, found {}; name one of them",
                agents.join(", ")
            );
            return Err(ExportError::Option(reason));
        }
        let scene = Scene::open(log, options)?;
        let mut writing = Writing {
            scene: &scene,
            summary: ExportedAgent {
                name: scene.agents[0].name.clone(),
                place: "velodyne".into(),
                height_m: Some(scene.agents[0].height),
                ..ExportedAgent::default()
            },
            first: None,
            poses: String::new(),
            times: String::new(),
            beside_image: 0,
        };
        let left_out = scene.each_sweep(report, |sweep| writing.sweep(folder, &sweep))?;
        if writing.first.is_none() {
            let reason = "expected sweeps with points, a pose and boxes at one stamp, found none; see `realo info`";
            return Err(ExportError::unfit(log.path(), reason));
        }
        folder.write("poses.txt", writing.poses.as_bytes())?;
        folder.write("times.txt", writing.times.as_bytes())?;
        let mut exported = writing.exported();
        exported.left_out = left_out.lines(options.labels);
        Ok(exported)
    }
}

struct Writing<'a> {
    scene: &'a Scene<'a>,
    summary: ExportedAgent,
    /// Stamp of the first sweep, and where its LiDAR was.
    first: Option<(Nanos, Isometry3<f64>)>,
    poses: String,
    times: String,
    /// Boxes that are not in the image.
    beside_image: usize,
}

impl Writing<'_> {
    fn sweep(&mut self, folder: &mut Folder, sweep: &Sweep) -> Result<(), ExportError> {
        let agent = &self.scene.agents[sweep.agent];
        let number = self.summary.sweeps;
        folder.write(
            &format!("velodyne/{number:06}.bin"),
            &rows(&agent.in_lidar(&sweep.cloud), &sweep.cloud.intensity),
        )?;
        let lidar_from_body = agent.lidar_from_body();
        let labels: Vec<_> = sweep
            .boxes
            .iter()
            .map(|object| label(object, &lidar_from_body))
            .collect();
        self.beside_image += labels.iter().filter(|(_, is_shown)| !is_shown).count();
        let text: String = labels.into_iter().map(|(line, _)| line).collect();
        folder.write(&format!("label_2/{number:06}.txt"), text.as_bytes())?;
        folder.write(&format!("calib/{number:06}.txt"), CALIBRATION.as_bytes())?;
        let map_from_lidar = sweep.map_from_body * lidar_from_body.inverse();
        let (start, map_from_first) = *self.first.get_or_insert((sweep.stamp, map_from_lidar));
        let camera_from_lidar = camera_from_lidar();
        let moved = camera_from_lidar * map_from_first.inv_mul(&map_from_lidar) * camera_from_lidar.inverse();
        self.poses += &twelve(&moved);
        self.times += &format!("{:.9}\n", to_seconds(sweep.stamp - start));
        self.summary.sweeps += 1;
        self.summary.points += sweep.cloud.len();
        self.summary.boxes += sweep.boxes.len();
        Ok(())
    }

    fn exported(self) -> Exported {
        let Writing { scene, summary, .. } = self;
        let mut assumed = lost::assumed_heights(scene);
        assumed
            .push("the camera is at the LiDAR and looks ahead, with an image of 1242 × 375 pixels as KITTI's".into());
        assumed.push(format!(
            "{} of {} boxes are not in the image: their rectangle is 0 0 0 0, and `truncated` is 1",
            self.beside_image, summary.boxes
        ));
        let (start, _) = self.first.unwrap_or_default();
        let mut lines = vec![
            format!("the name of the agent: {}", summary.name),
            format!("the date: time 0 is at {start} ns"),
            "where the map is: read back, it is the frame of the first LiDAR".into(),
            "tracks and velocities of boxes".into(),
            "outlines of vehicles and words about sensors".into(),
        ];
        lines.push(lost::SCORED.into());
        lines.extend(lost::of_frames(scene).iter().map(ToString::to_string));
        let height = number(scene.agents[0].height);
        let footprint = lost::footprint(scene.agents.iter()).unwrap_or_default();
        Exported {
            read_back: format!("realo-lab import kitti PATH -o LOG.mcap --height {height}{footprint}"),
            agents: vec![summary],
            assumed,
            lost: lines,
            ..Exported::default()
        }
    }
}

/// Rows of float32: x, y, z and intensity in 0…1.
fn rows(points: &[[f32; 3]], intensity: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(16 * points.len());
    for ([x, y, z], intensity) in points.iter().zip(intensity) {
        for number in [*x, *y, *z, f32::from(*intensity) / 255.0] {
            bytes.extend_from_slice(&number.to_le_bytes());
        }
    }
    bytes
}

/// A pose as a line of three rows.
fn twelve(pose: &Isometry3<f64>) -> String {
    let rows = pose.to_homogeneous().transpose();
    let words: Vec<String> = rows.as_slice()[..12].iter().map(|value| number(*value)).collect();
    format!("{}\n", words.join(" "))
}
