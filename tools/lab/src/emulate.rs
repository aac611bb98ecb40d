//! `realo-lab emulate`: two machines in one.

use std::io::BufRead;
use std::net::SocketAddr;
use std::sync::Arc;

use eyre::{Result, WrapErr, bail};
use linkemu::{ADDRESSES, Ground, Interrupts, Link, Machines, Relay, Unit};
use realo_cli::Outcome;
use realo_cli::program::called_beside;

/// Makes two machines of one, joined by a slow link, until it is interrupted
///
/// As root, two network namespaces; else the same in a user namespace. Where neither may be made, a relay on loopback carries TCP
/// with the rate, delay, queue and cuts of the link; it loses nothing, nor carries it twice. It says which.
///
/// Lines of its standard input change the link: `rate 6`, `delay 30`, `jitter 5`, `queue 200`, `loss 0.01`, `duplicate 0.1`,
/// `half_duplex 1`, `cut 1`, `cut 0`; `stat` reports what was carried.
#[derive(clap::Args)]
pub struct Args {
    /// Mbit/s each way, 0: no limit
    #[arg(long, default_value_t = 27.0)]
    rate: f64,
    /// One way, ms
    #[arg(long, default_value_t = 20.0)]
    delay: f64,
    /// Up to so much more, ms, of each packet its own: packets overtake each other
    #[arg(long, default_value_t = 0.0)]
    jitter: f64,
    /// What waits for the link at most, ms
    #[arg(long, default_value_t = 100.0)]
    queue: f64,
    /// Share of packets that are lost
    #[arg(long, default_value_t = 0.0)]
    loss: f64,
    /// Share of packets of which a copy follows
    #[arg(long, default_value_t = 0.0)]
    duplicate: f64,
    /// Both directions share the rate
    #[arg(long)]
    half_duplex: bool,
    /// No namespaces: a relay of TCP from 127.0.0.2 to 127.0.0.1, of the ports PORT and PORT + 1
    #[arg(long)]
    loopback: bool,
    /// Port of the relay
    #[arg(long, default_value_t = 7447)]
    port: u16,
    /// Names of the machines [default: car,roadside]
    #[arg(long, value_delimiter = ',', hide_default_value = true, default_values_t = ["car".to_string(), "roadside".to_string()])]
    names: Vec<String>,
}

/// Makes the machines and waits.
pub fn main(args: &Args) -> Result<Outcome> {
    if !(1..u16::MAX).contains(&args.port) {
        let found = args.port;
        bail!("--port: expected one with another behind it, from 1 to 65534, found {found}");
    }
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
        ("duplicate", args.duplicate),
        ("half_duplex", if args.half_duplex { 1.0 } else { 0.0 }),
    ] {
        if let (false, Some(unit)) = (link.set(what, value), Unit::of(what)) {
            bail!("--{what}: expected {unit}, found {value}");
        }
    }
    let interrupts = Interrupts::hold();
    let place = place(args, [first, second], &link)?;
    println!("Ctrl-C ends it");
    let is_relay = matches!(place, Place::Loopback(_));
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().split(b'\n').map_while(Result::ok) {
            let line = String::from_utf8_lossy(&line);
            let what = line.split_whitespace().next().unwrap_or_default();
            if is_relay && Unit::of(what) == Some(Unit::Share) {
                eprintln!("realo-lab: {what}: {OF_PACKETS}");
            } else if !obey(&link, &line) {
                let expected = match Unit::of(what) {
                    Some(unit) => format!("`{what}` and {unit}"),
                    None => "`WHAT NUMBER` (realo-lab emulate --help)".into(),
                };
                eprintln!("realo-lab: expected {expected}, found `{}`", line.trim_end());
            }
        }
    });
    interrupts.wait();
    drop(place);
    Ok(Outcome::Complete)
}

/// What joins the machines; goes with it.
#[allow(dead_code, reason = "held until the end")]
enum Place {
    Namespaces(Machines),
    Loopback(Relay),
}

const OF_PACKETS: &str = "the relay carries streams, of which TCP lets nothing be lost or come twice; it needs namespaces, as root or \
                          where users may make them";

fn place(args: &Args, names: [&str; 2], link: &Arc<Link>) -> Result<Place> {
    if !args.loopback {
        match Machines::join(names[0], names[1], link.clone()) {
            Ok(machines) => {
                report_namespaces(names)?;
                return Ok(Place::Namespaces(machines));
            }
            Err(error @ linkemu::Error::Nowhere { .. }) => eprintln!("realo-lab: {error}"),
            Err(error) => return Err(error.into()),
        }
    }
    for (what, share) in [("loss", args.loss), ("duplicate", args.duplicate)] {
        if share > 0.0 {
            bail!("--{what}: {OF_PACKETS}");
        }
    }
    let [near, far] = relayed(args.port);
    let ways: Vec<_> = near.into_iter().zip(far).collect();
    let relay = Relay::start(link.clone(), &ways).wrap_err("the relay; choose another --port")?;
    let ([first, second], port, realo) = (names, args.port, called_beside("realo"));
    println!(
        "a relay on loopback: nothing is lost, comes twice or is overtaken, a full queue holds senders up, congestion control has no work"
    );
    println!(
        "`{first}` listens on {}, which `{second}` finds as {}; for example:",
        far[0], near[0]
    );
    println!(
        "  {realo} run dataflows/late_fusion.vehicle.yml --set v2x.listen=tcp/{}",
        far[0]
    );
    println!(
        "  {realo} run dataflows/late_fusion.roadside.yml --set v2x.connect=tcp/{} --set player.repeat=100",
        near[0]
    );
    println!("(the ports {port} and {}, which points and features take)", port + 1);
    Ok(Place::Loopback(relay))
}

/// The relay's own addresses, and those that it leads to: a radio takes a port and the one behind it.
pub(crate) fn relayed(port: u16) -> [[SocketAddr; 2]; 2] {
    [[127, 0, 0, 2], [127, 0, 0, 1]]
        .map(|host| [port, port.saturating_add(1)].map(|port| SocketAddr::from((host, port))))
}

fn report_namespaces([first, second]: [&str; 2]) -> Result<()> {
    let enter = match Ground::find()? {
        Ground::System => {
            println!("two network namespaces");
            "ip netns exec".to_string()
        }
        Ground::User => {
            println!("two network namespaces in a user namespace of this process");
            let id = std::process::id();
            format!("nsenter -t {id} -U -m --preserve-credentials --wd=. ip netns exec")
        }
    };
    println!(
        "`{first}` is {}, `{second}` is {}; on them, for example:",
        ADDRESSES[0], ADDRESSES[1]
    );
    let realo = called_beside("realo");
    println!("  {enter} {first} {realo} run dataflows/late_fusion.vehicle.yml");
    println!(
        "  {enter} {second} {realo} run dataflows/late_fusion.roadside.yml --set v2x.connect=tcp/{}:7447 --set player.repeat=100",
        ADDRESSES[0]
    );
    Ok(())
}

fn obey(link: &Link, line: &str) -> bool {
    let mut words = line.split_whitespace();
    match (words.next(), words.next(), words.next()) {
        (None, ..) => true,
        (Some("stat"), None, None) => {
            for (way, counts) in ["there", "back"].iter().zip(link.counts()) {
                println!(
                    "{way}: {} packets, {} bytes, {} lost, {} came twice, {} found the queue full",
                    counts.packets, counts.bytes, counts.lost, counts.duplicated, counts.overflown
                );
            }
            true
        }
        (Some(what), Some(value), None) => value.parse().is_ok_and(|value| link.set(what, value)),
        _ => false,
    }
}
