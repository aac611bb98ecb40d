//! How long sync takes for one sweep of 230,000 points: `cargo run --release -p realo-sync --example sweep_time`.
use std::time::Instant;

use nalgebra::{Isometry3, Vector3};
use realo_operator::{Operator, Outputs, PortId};
use realo_schemas::{AgentState, Header, Kind, Message, Nanos, PointCloud, PoseStatus};
use realo_sync::{Sync, SyncConfig};

const MS: Nanos = 1_000_000;

fn main() {
    let n = 230_000;
    let angle = |i: usize| (i / 128) as f32 / 1797.0 * std::f32::consts::TAU;
    let x: Vec<f32> = (0..n).map(|i| 50.0 * angle(i).cos()).collect();
    let y: Vec<f32> = (0..n).map(|i| 50.0 * angle(i).sin()).collect();
    let time: Vec<i32> = (0..n).map(|i| (i / 128) as i32 * 55_600 - 50_000_000).collect();
    let cloud = PointCloud::new(x, y, vec![0.5f32; n], vec![1u8; n], time, vec![3u16; n]).expect("equal columns");
    let header = |kind, seq, stamp, ready| Header::origin(&"run".into(), &"cav1".into(), kind, seq, stamp, ready);
    for deskew in [true, false] {
        let mut sync = Sync::new(SyncConfig {
            deskew,
            ..SyncConfig::default()
        })
        .expect("defaults are good");
        let mut best = f64::MAX;
        for seq in 0..50 {
            let start = 100 * MS * seq as Nanos;
            for stamp in (0..10).map(|i| start + 10 * MS * i) {
                let seconds = realo_schemas::to_seconds(stamp);
                let map_from_body = Isometry3::new(Vector3::x() * 20.0 * seconds, Vector3::z() * 0.5 * seconds);
                let (covariance, velocity, angular_rate, status) = (None, None, None, PoseStatus::Truth);
                let state = AgentState {
                    map_from_body,
                    covariance,
                    velocity,
                    angular_rate,
                    status,
                };
                let pose = Message::new(header(Kind::AgentState, 0, stamp, stamp), state);
                sync.on_input(PortId(0), pose, &mut Outputs::at(stamp))
                    .expect("a good pose");
            }
            let sweep = Message::new(
                header(Kind::Points, seq, start + 50 * MS, start + 100 * MS),
                cloud.clone(),
            );
            let mut out = Outputs::at(start + 100 * MS);
            let begin = Instant::now();
            sync.on_input(PortId(1), sweep, &mut out).expect("a good sweep");
            best = best.min(begin.elapsed().as_secs_f64());
            assert_eq!(out.take_sent().len(), 2);
        }
        println!("deskew {deskew}: {:.2} ms at best of 50 sweeps", best * 1e3);
    }
}
