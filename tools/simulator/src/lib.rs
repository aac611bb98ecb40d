//! A simulated world of vehicles and roadside units, and the LiDARs that see it.
//!
//! ```no_run
//! use realo_simulator::{Options, Simulation};
//!
//! let simulation = Simulation::new(&Options { seed: 7, seconds: 2.0, ..Options::default() })?;
//! for sweep in simulation.sweeps() {
//!     println!("{} {}: {} points on {} objects", sweep.agent, sweep.seq, sweep.cloud.len(), sweep.truth.len());
//! }
//! # Ok::<(), realo_simulator::Error>(())
//! ```
//!
//! **The world.** Thirteen places ([`Scenario`]): two whose roads are straight and cross squarely between houses
//! (`intersection`, `corridor`), and eleven whose roads run at any angle, bent, on slopes of up to 3 %, most of them open
//! beside the road. Each is drawn anew for every number: angles, radii, lanes, lights, bays, houses. Lanes, cycle lanes,
//! parking bays, kerbs, crowned roads, buildings, poles, trees; ground that is not quite flat. Vehicles follow each
//! other (Intelligent Driver Model), change lanes, obey the lights and each other's right of way; walkers keep to
//! pavements and crossings. `cav1` and `cav2` are cars of that traffic, come by two arms (on a network: two lanes), near
//! each other and `rsu1` for most of the first ten seconds; `rsu1` and `rsu2` stand on 5 m poles at corners, level (on a
//! network they look across the node and along the arm ahead). A
//! vehicle that stays for longer turns round at the end of the road if it is a cav, and else leaves the place. Every
//! road user is an object of truth, named by V2X-Real's raw classes: Car, Van, Truck, Bus, MotorcyleRider (sic),
//! BicycleRider, ScooterRider, Pedestrian, Child. On networks there are also lorries with trailers (one Truck),
//! tricycles (MotorcyleRider), somebody with a pram (one Pedestrian), and groups of people.
//!
//! **Sensors.** `cav1`, `cav2`: 128 beams by the Ruby Plus table, 1,800 columns, 1.9 m over the ground, tilted with
//! the car; the own roof and bonnet are in the cloud. `rsu1`: OS1-128, `rsu2`: OS1-64, 1,024 columns. All turn at
//! 10 Hz, clockwise from the rear. Each ray is cast at its own firing time against the world of that instant. Beams
//! have no width: there are no mixed returns at edges. Rings are numbered from the lowest beam up. Other sensors come
//! by name or from files ([`Sensor::named`]), fleets have up to sixteen agents ([`fleet`]).
//!
//! **Motion.** An inertial unit, a satellite receiver and wheels measure each vehicle's true motion with the errors of a named
//! unit ([`MotionUnit`]); roadside units have the receiver. Clocks of agents may be wrong, and drives may be on another day.
//!
//! **Frames and time.** Body frames are gravity-aligned with z = 0 on the ground below the sensor; x is forward, for
//! roadside units along the main road. The place is turned in `map` by an angle of its own. Logs start at [`EPOCH`];
//! a stamp is the middle of its sweep.
//!
//! **Seeds.** 0–799 are for training, 800–899 for validation, 900–999 for tests; 1,000,000 and more are reserved for
//! release checks. All draws come from named streams of one seed and per-ray hashes: the same options give the same
//! bits on any number of threads.

/// Rises with every change of what a seed gives, so that what was made of it earlier is known apart.
pub const WORLD: u32 = 8;

mod agents;
mod bench;
mod bodies;
mod cast;
mod detections;
mod inertial;
mod log;
mod options;
mod path;
mod place;
mod poses;
mod random;
mod sensor;
mod shapes;
mod simulation;
mod solid;
pub mod statistics;
mod traffic;

pub use agents::{AgentInfo, AgentKind};
pub use bench::{Bench, PlaceBench, SensorBench, bench, points_per_second};
pub use inertial::{FIX_PERIOD, MAP_ORIGIN, MotionRecord, MotionUnit, Timed, WHEEL_PERIOD};
pub use log::{WriteError, Written, write_log};
pub use options::{
    AGENTS, EPOCH, Error, MOST_AGENTS, Options, POSE_PERIOD, Phase, PoseNoise, SWEEP_PERIOD, Scenario, Weather, fleet,
};
pub use poses::PoseSample;
pub use sensor::{Sensor, SensorError};
pub use simulation::{Simulation, Sweep, Sweeps};
