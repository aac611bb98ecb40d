//! `realo emulate`: two machines in one.

use std::io::BufRead;
use std::sync::Arc;

use eyre::{Result, bail};
use linkemu::{ADDRESSES, Interrupts, Link, Machines};

use crate::Outcome;

/// Makes two network namespaces, joined by a slow link, until it is interrupted; needs root
///
/// Lines of its standard input change the link: `rate 6`, `delay 30`, `jitter 5`, `queue 200`, `loss 0.01`, `half_duplex 1`, `cut 1`,
/// `cut 0`; `stat` tells what was carried.
#[derive(clap::Args)]
pub struct Args {
    /// Mbit/s each way, 0: no limit
    #[arg(long, default_value_t = 27.0)]
    rate: f64,
    /// One way, ms
    #[arg(long, default_value_t = 20.0)]
    delay: f64,
    /// Up to so much more, ms
    #[arg(long, default_value_t = 0.0)]
    jitter: f64,
    /// What waits for the link at most, ms
    #[arg(long, default_value_t = 100.0)]
    queue: f64,
    /// Share of packets that are lost
    #[arg(long, default_value_t = 0.0)]
    loss: f64,
    /// Both directions share the rate
    #[arg(long)]
    half_duplex: bool,
    /// Names of the namespaces
    #[arg(long, value_delimiter = ',', default_values_t = ["car".to_string(), "roadside".to_string()])]
    names: Vec<String>,
}

/// Makes the machines and waits.
pub fn main(args: &Args) -> Result<Outcome> {
    let [first, second] = &*args.names else {
        bail!("--names: expected two, as car,roadside, found {}", args.names.join(","));
    };
    let link = Arc::new(Link::default());
    for (what, value) in [
        ("rate", args.rate),
        ("delay", args.delay),
        ("jitter", args.jitter),
        ("queue", args.queue),
        ("loss", args.loss),
        ("half_duplex", if args.half_duplex { 1.0 } else { 0.0 }),
    ] {
        if !link.set(what, value) {
            bail!("--{what}: expected a number from 0 on, found {value}");
        }
    }
    let interrupts = Interrupts::hold();
    let machines = Machines::join(first, second, link.clone())?;
    println!(
        "`{first}` is {}, `{second}` is {}; on them, for example:",
        ADDRESSES[0], ADDRESSES[1]
    );
    println!("  ip netns exec {first} realo run dataflows/late_fusion.vehicle.yml");
    println!(
        "  ip netns exec {second} realo run dataflows/late_fusion.roadside.yml --set v2x.connect=tcp/{}:7447",
        ADDRESSES[0]
    );
    println!("Ctrl-C ends them");
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines().map_while(Result::ok) {
            if !obey(&link, &line) {
                eprintln!("realo: expected `WHAT NUMBER` (realo emulate --help), found `{line}`");
            }
        }
    });
    interrupts.wait();
    drop(machines);
    Ok(Outcome::Complete)
}

fn obey(link: &Link, line: &str) -> bool {
    let mut words = line.split_whitespace();
    match (words.next(), words.next(), words.next()) {
        (None, ..) => true,
        (Some("stat"), None, None) => {
            for (way, counts) in ["there", "back"].iter().zip(link.counts()) {
                println!(
                    "{way}: {} packets, {} bytes, {} lost, {} found the queue full",
                    counts.packets, counts.bytes, counts.lost, counts.overflown
                );
            }
            true
        }
        (Some(what), Some(value), None) => value.parse().is_ok_and(|value| link.set(what, value)),
        _ => false,
    }
}
