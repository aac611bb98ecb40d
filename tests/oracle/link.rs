//! The links once more: who is in reach when a packet is sent, and what arrives when.

use std::collections::BTreeSet;

use realo_schemas::Nanos;

use crate::draw::{Copies, Message, copies};
use crate::stage::{At, Class, Place, serve_all};
use crate::world::{Channel, EGO, Strategy, World};

/// Packets of one sender that wait until it has reported a position.
const WAITING: usize = 16;

/// A message that entered a channel.
pub struct Sent<'w> {
    pub at: At<'w>,
    pub to: &'w str,
    pub bytes: usize,
    pub copies: Copies,
    /// When the call that sent it was done.
    done: Nanos,
    /// How long before that call it was sent; that much of its delay is over.
    waited: Nanos,
}

impl<'w> Sent<'w> {
    /// The copies where they arrive.
    pub fn arrivals(&self) -> Vec<At<'w>> {
        let delays = [self.copies.first, self.copies.second].into_iter().flatten();
        let arrival = |delay: Nanos| At {
            ready: self.done + (delay - self.waited).max(0),
            ..self.at
        };
        delays.map(arrival).collect()
    }
}

/// What a link did with packets.
#[derive(Default)]
pub struct Crossed<'w> {
    pub sent: Vec<Sent<'w>>,
    /// Sender and receiver of those that did not pass the gate.
    pub out_of_range: Vec<(&'w str, &'w str)>,
    /// How many of those had waited for a position, and more came behind them than may wait.
    pub pushed_out: u64,
}

/// What a link is called with.
#[derive(Clone, Copy)]
enum What<'w> {
    Position(At<'w>),
    Packet(At<'w>),
}

/// A link and its calls in order.
pub struct Link<'w> {
    world: &'w World,
    stage: &'static str,
    kind: &'static str,
    channel: Channel,
    calls: Vec<(Place<'w>, What<'w>)>,
}

impl<'w> Link<'w> {
    /// The link of sweeps.
    pub fn of_sweeps(world: &'w World, others: &[At<'w>]) -> Self {
        Link::new(world, "link", kind(world), world.channel, &[], others)
    }

    /// The link of states.
    pub fn of_states(world: &'w World, ego: &[At<'w>], others: &[At<'w>]) -> Self {
        Link::new(world, "state-link", "agent_state", world.state_channel, ego, others)
    }

    fn new(
        world: &'w World,
        stage: &'static str,
        kind: &'static str,
        channel: Channel,
        ego: &[At<'w>],
        others: &[At<'w>],
    ) -> Self {
        let positions = world.states.iter().map(|said| {
            let at = At::log(said);
            let port = if at.agent() == EGO { 0 } else { 1 };
            (at.place(Class::State, port), What::Position(at))
        });
        let packets = |list: &[At<'w>], port: usize| {
            let packet = |at: &At<'w>| (at.place(Class::Data, port), What::Packet(*at));
            list.iter().map(packet).collect::<Vec<_>>()
        };
        let all = positions.chain(packets(ego, 2)).chain(packets(others, 3));
        Link {
            world,
            stage,
            kind,
            channel,
            calls: serve_all(all.collect(), world.compute(stage)),
        }
    }

    /// The packets of others to the ego. One whose sender has reported no position yet waits for it, offline for the ego's too.
    pub fn to_ego(&self) -> Crossed<'w> {
        let mut crossed = Crossed::default();
        for (number, (place, what)) in self.calls.iter().enumerate() {
            let What::Packet(at) = *what else { continue };
            if at.agent() == EGO {
                continue;
            }
            let sender = self.first_position(at.agent());
            let known = match self.world.offline {
                true => sender.zip(self.first_position(EGO)).map(|(a, b)| a.max(b)),
                false => sender,
            };
            let Some(known) = known else {
                crossed.out_of_range.push((at.agent(), EGO));
                continue;
            };
            if known < number {
                self.carry(&mut crossed, at, EGO, number, place.0, place.0);
                continue;
            }
            let of_sender =
                |(_, what): &&(Place, What)| matches!(what, What::Packet(other) if other.agent() == at.agent());
            let behind = self.calls[number + 1..=known].iter().filter(of_sender).count();
            if behind < WAITING {
                self.carry(&mut crossed, at, EGO, known + 1, self.calls[known].0.0, place.0);
            } else {
                crossed.out_of_range.push((at.agent(), EGO));
                crossed.pushed_out += 1;
            }
        }
        crossed
    }

    /// The ego's packets, to each other of whom a state or a packet came before.
    pub fn to_others(&self) -> Crossed<'w> {
        let mut crossed = Crossed::default();
        for (number, (place, what)) in self.calls.iter().enumerate() {
            let What::Packet(at) = *what else { continue };
            if at.agent() != EGO {
                continue;
            }
            let heard_of: BTreeSet<&str> = self.calls[..number].iter().map(|(_, what)| what_agent(what)).collect();
            for other in heard_of.into_iter().filter(|other| *other != EGO) {
                self.carry(&mut crossed, at, other, number, place.0, place.0);
            }
        }
        crossed
    }

    /// Number of the call with the first position of an agent.
    fn first_position(&self, agent: &str) -> Option<usize> {
        let first = |(_, what): &(Place, What)| matches!(what, What::Position(at) if at.agent() == agent);
        self.calls.iter().position(first)
    }

    /// The position of newest stamp among the first calls.
    fn position(&self, agent: &str, calls: usize) -> Option<[f64; 2]> {
        let reported = self.calls[..calls].iter().filter_map(|(_, what)| match what {
            What::Position(at) if at.agent() == agent => Some(at.said),
            _ => None,
        });
        reported.max_by_key(|said| said.stamp)?.spot.map(|spot| spot.at)
    }

    /// Sends a packet after so many calls, in a call that began at `start`; it came at `came`.
    fn carry(&self, crossed: &mut Crossed<'w>, at: At<'w>, to: &'w str, calls: usize, start: Nanos, came: Nanos) {
        let world = self.world;
        let both = self.position(at.agent(), calls).zip(self.position(to, calls));
        let in_reach = both.is_some_and(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1]) <= world.range_m);
        if !in_reach {
            return crossed.out_of_range.push((at.agent(), to));
        }
        let message = Message {
            seed: world.channel_seed,
            from: at.agent(),
            to,
            kind: self.kind,
            seq: at.said.seq,
        };
        let bytes = match self.kind {
            "agent_state" => envelope(&at) + 2 + 56,
            _ => bytes(world, &at),
        };
        let at_once = Copies {
            first: Some(0),
            second: None,
        };
        crossed.sent.push(Sent {
            at,
            to,
            bytes,
            copies: if world.offline {
                at_once
            } else {
                copies(&self.channel, message, bytes)
            },
            done: start + world.compute(self.stage),
            waited: start - came,
        });
    }
}

fn what_agent<'w>(what: &What<'w>) -> &'w str {
    match what {
        What::Position(at) | What::Packet(at) => at.agent(),
    }
}

/// What sweeps cross as.
pub fn kind(world: &World) -> &'static str {
    match world.strategy {
        Strategy::Late => "boxes",
        Strategy::Early | Strategy::Projected => "points",
    }
}

/// Size of a packet's envelope, by the layout that `realo-transmission` documents.
fn envelope(at: &At) -> usize {
    let frame = at.by.map_or(0, |ego| 1 + ego.agent.len() + "/body".len());
    21 + 1 + at.agent().len() + frame
}

/// Size of a sweep's packet, by the same layout.
pub fn bytes(world: &World, at: &At) -> usize {
    let pose = if at.said.spot.is_some() { 56 } else { 0 };
    let count = at.said.count;
    let content = match world.strategy {
        Strategy::Late => {
            let classes = if count > 0 { 1 + "Car".len() } else { 0 };
            3 + classes + count * (34 + if at.said.tracked { 12 + 4 } else { 0 })
        }
        Strategy::Early | Strategy::Projected => 5 + 13 * count,
    };
    // Who projects says where it is itself.
    let position = if at.by.is_some() { 24 } else { 0 };
    envelope(at) + pose + position + content
}
