use realo_simulator::*;
use std::io::Write;
fn main() {
    let a: Vec<String> = std::env::args().collect();
    if a[1] == "bench" {
        println!(
            "{:#?}",
            bench(std::env::args().nth(2).map_or(10.0, |s| s.parse().unwrap())).unwrap()
        );
        return;
    }
    if a[1] == "survey" {
        for scenario in [Scenario::Intersection, Scenario::Corridor] {
            for dense in [false, true] {
                let (mut least, mut most, mut bad, mut build) = (usize::MAX, 0, 0, 0.0);
                let (mut points, mut all) = (vec![0usize; 4], vec![]);
                for seed in 0..40 {
                    let t = std::time::Instant::now();
                    let sim = Simulation::new(&Options {
                        scenario,
                        seed,
                        dense,
                        column_stride: 1000,
                        clouds: false,
                        ..Options::default()
                    })
                    .unwrap();
                    build += t.elapsed().as_secs_f64();
                    let p: Vec<Vec<_>> = ["cav1", "cav2", "rsu1"]
                        .iter()
                        .map(|a| {
                            sim.poses(a)
                                .unwrap()
                                .iter()
                                .map(|p| p.truth.map_from_body.translation.vector.xy())
                                .collect()
                        })
                        .collect();
                    let n = p[0].len();
                    let near = (0..n)
                        .filter(|i| {
                            (p[0][*i] - p[1][*i]).norm() < 70.0
                                && (p[0][*i] - p[2][*i]).norm() < 70.0
                                && (p[1][*i] - p[2][*i]).norm() < 70.0
                        })
                        .count();
                    let moved: Vec<i64> = (0..2).map(|k| (p[k][n - 1] - p[k][0]).norm() as i64).collect();
                    if near * 10 < n * 7 {
                        bad += 1;
                    }
                    all.push((near * 100 / n, moved));
                    for s in sim.sweeps().take(40) {
                        least = least.min(s.truth.len());
                        most = most.max(s.truth.len());
                    }
                    let _ = &mut points;
                }
                println!(
                    "{scenario:?} dense {dense}: truth {least}..{most}, bad {bad}, build {:.0} ms {all:?}",
                    build * 1000.0 / 40.0
                );
            }
        }
        return;
    }
    let scenario = if a[1] == "corridor" {
        Scenario::Corridor
    } else {
        Scenario::Intersection
    };
    let seed: u64 = a[2].parse().unwrap();
    let dense = a[3] == "dense";
    let seconds: f64 = a[4].parse().unwrap();
    let t = std::time::Instant::now();
    let sim = Simulation::new(&Options {
        scenario,
        seed,
        dense,
        seconds,
        labels: true,
        ..Options::default()
    })
    .unwrap();
    eprintln!("build {:?}", t.elapsed());
    let every: usize = a[5].parse().unwrap();
    let t = std::time::Instant::now();
    let (mut n, mut sweeps) = (0, 0);
    let mut o = std::io::BufWriter::new(std::fs::File::create("/tmp/viz/dump.txt").unwrap());
    for s in sim.sweeps() {
        n += s.cloud.len();
        sweeps += 1;
        if s.seq as usize % every != 0 {
            continue;
        }
        writeln!(o, "S {} {} {} {}", s.agent, s.seq, s.cloud.len(), s.truth.len()).unwrap();
        let p = sim
            .poses(&s.agent)
            .unwrap()
            .into_iter()
            .find(|p| p.stamp == s.stamp)
            .unwrap();
        let m = p.truth.map_from_body;
        writeln!(
            o,
            "M {} {} {} {}",
            m.translation.x,
            m.translation.y,
            m.translation.z,
            m.rotation.euler_angles().2
        )
        .unwrap();
        for (b, n) in s.truth.iter().zip(&s.points) {
            writeln!(
                o,
                "T {} {} {} {} {} {} {} {} {} {}",
                b.class,
                b.center[0],
                b.center[1],
                b.center[2],
                b.length,
                b.width,
                b.height,
                b.yaw,
                n,
                b.velocity.unwrap()[0]
            )
            .unwrap();
        }
        for b in &s.detections.0 {
            writeln!(
                o,
                "D {} {} {} {} {} {} {} {} {}",
                b.class, b.center[0], b.center[1], b.center[2], b.length, b.width, b.height, b.yaw, b.score
            )
            .unwrap();
        }
        for i in 0..s.cloud.len() {
            writeln!(
                o,
                "P {} {} {} {} {}",
                s.cloud.x[i], s.cloud.y[i], s.cloud.z[i], s.cloud.intensity[i], s.labels[i]
            )
            .unwrap();
        }
    }
    eprintln!("{sweeps} sweeps, {n} points, {:?}", t.elapsed());
}
