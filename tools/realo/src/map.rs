//! `realo map`: maps of what stands still, for localization.

mod build;
mod estimated;
mod report;
mod sweeps;

use std::fmt;
use std::path::PathBuf;

use eyre::Result;
use realo_cli::Outcome;
use realo_registration::{Closure, VoxelMap};
use serde::Serialize;

/// Builds maps for localization, and describes them
#[derive(clap::Args)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(clap::Subcommand)]
enum Command {
    Build(build::Args),
    Info(InfoArgs),
}

/// Describes maps
#[derive(clap::Args)]
struct InfoArgs {
    /// Map files
    #[arg(required = true)]
    maps: Vec<PathBuf>,
    /// As JSON
    #[arg(long)]
    json: bool,
}

/// Builds or describes.
pub fn main(args: &Args) -> Result<Outcome> {
    match &args.command {
        Command::Build(args) => build::main(args),
        Command::Info(args) => {
            for path in &args.maps {
                let described = Description::of(path.display().to_string(), &VoxelMap::open(path)?);
                match args.json {
                    true => println!("{}", serde_json::to_string_pretty(&described)?),
                    false => println!("{described}"),
                }
            }
            Ok(Outcome::Complete)
        }
    }
}

/// What there is to say of a map.
#[derive(Serialize)]
struct Description {
    path: String,
    bytes: usize,
    frame: String,
    voxel_m: f64,
    thickness_m: f64,
    origin: [f64; 3],
    voxels: usize,
    planar: usize,
    left_out: u64,
    /// Standard deviations of the poses that placed the sweeps: on the ground, up, m, of the heading, rad.
    pose_sigmas: [f64; 3],
    sweeps: u64,
    /// Stamps of the first and the last sweep, ns.
    span: [i64; 2],
    /// Smallest and largest mean of a voxel along each axis, m in the frame.
    extent: [[f64; 2]; 3],
    /// How a pose graph found the poses; absent where they were given.
    #[serde(skip_serializing_if = "Option::is_none")]
    closure: Option<ClosureDescription>,
}

/// [`Closure`], in JSON.
#[derive(Serialize)]
struct ClosureDescription {
    keyframes: u64,
    loops: u64,
    /// What loops were off before and after, root mean square: m, rad.
    residuals_m: [f64; 2],
    residuals_rad: [f64; 2],
}

impl From<Closure> for ClosureDescription {
    fn from(closure: Closure) -> Self {
        ClosureDescription {
            keyframes: closure.keyframes,
            loops: closure.loops,
            residuals_m: closure.residuals_m,
            residuals_rad: closure.residuals_rad,
        }
    }
}

impl Description {
    fn of(path: String, map: &VoxelMap) -> Self {
        let info = map.info();
        let (mut planar, mut extent) = (0, [[f64::INFINITY, f64::NEG_INFINITY]; 3]);
        for voxel in map.voxels() {
            planar += usize::from(voxel.is_planar);
            for ([low, high], part) in extent.iter_mut().zip(voxel.mean.iter()) {
                (*low, *high) = (low.min(*part), high.max(*part));
            }
        }
        if map.is_empty() {
            extent = [[0.0; 2]; 3];
        }
        Description {
            path,
            bytes: map.as_bytes().len(),
            frame: info.frame.clone(),
            voxel_m: info.voxel_m,
            thickness_m: info.thickness_m,
            origin: info.origin.into(),
            voxels: map.len(),
            planar,
            left_out: info.left_out,
            pose_sigmas: info.pose_sigmas,
            sweeps: info.sweeps,
            span: info.span,
            extent,
            closure: info.closure.map(ClosureDescription::from),
        }
    }
}

impl fmt::Display for Description {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        let share = 100.0 * self.planar as f64 / self.voxels.max(1) as f64;
        let seconds = realo_schemas::to_seconds(self.span[1].saturating_sub(self.span[0]));
        let [x, y, z] = self.extent;
        let [ox, oy, oz] = self.origin;
        writeln!(f, "{}: a map of {:.2} MB", self.path, self.bytes as f64 * 1e-6)?;
        writeln!(
            f,
            "  voxels    {} of {} m, {share:.0} % of them planar; {} cells left out: seen too seldom, or seen empty",
            self.voxels, self.voxel_m, self.left_out
        )?;
        writeln!(f, "  sweeps    {} in {seconds:.1} s", self.sweeps)?;
        let [ground, up, heading] = self.pose_sigmas;
        let heading = heading.to_degrees();
        writeln!(
            f,
            "  poses     ± {ground:.3} m on the ground, {up:.3} m up, {heading:.3}°"
        )?;
        if let Some(closure) = &self.closure {
            writeln!(f, "  loops     {}", closed(closure))?;
        }
        writeln!(
            f,
            "  frame     `{}`, origin at ({ox:.2}, {oy:.2}, {oz:.2}) m",
            self.frame
        )?;
        write!(
            f,
            "  extent    x {:.1} to {:.1}, y {:.1} to {:.1}, z {:.1} to {:.1} m",
            x[0], x[1], y[0], y[1], z[0], z[1]
        )
    }
}

/// What became of loops, in words.
fn closed(closure: &ClosureDescription) -> String {
    let ClosureDescription { keyframes, loops, .. } = closure;
    if *loops == 0 {
        return format!("none was closed among {keyframes} keyframes: odometry and GNSS alone place them");
    }
    let [before, after] = closure.residuals_m;
    let [turned_before, turned_after] = closure.residuals_rad.map(f64::to_degrees);
    format!(
        "{loops} closed among {keyframes} keyframes; they were {before:.3} m and {turned_before:.3}° off before, {after:.3} m and \
         {turned_after:.3}° after (root mean square)"
    )
}
