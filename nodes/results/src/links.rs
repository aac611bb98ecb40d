//! Joins what stages counted and said into the books of every channel.

use std::collections::BTreeMap;

use realo_operator::{Books, InputBooks};
use realo_schemas::Kind;
use realo_schemas::report::Channel;

use crate::ledger::ChannelKey;
use crate::{Accounted, LinkBooks, Settled};

/// The books of all channels, by `<from>-<to>` and kind.
///
/// `settled`: what became of the messages of each channel. A channel is accounted for where a stage takes what it
/// delivers and says what becomes of it.
pub fn link_books(
    settled: &BTreeMap<ChannelKey, Settled>,
    books: &Books,
) -> BTreeMap<String, BTreeMap<String, LinkBooks>> {
    let mut links: BTreeMap<String, BTreeMap<String, LinkBooks>> = BTreeMap::new();
    for channel in books.nodes.values().flat_map(|node| &node.channels) {
        let key = (channel.from.clone(), channel.to.clone(), channel.kind);
        let Settled { fates, lost } = settled.get(&key).copied().unwrap_or_default();
        let traffic = channel.traffic;
        let accounted = is_accounted(channel, books).then(|| Accounted {
            fates,
            unaccounted: traffic.sent as i64 - lost as i64 - fates.total() as i64,
        });
        let link = links.entry(format!("{}-{}", channel.from, channel.to)).or_default();
        let line = LinkBooks {
            sent: traffic.sent,
            bytes: traffic.bytes,
            lost,
            duplicated: traffic.duplicated,
            out_of_range: traffic.out_of_range,
            accounted,
        };
        match link.get_mut(channel.kind.as_str()) {
            Some(sum) => sum.add(&line),
            None => {
                link.insert(channel.kind.to_string(), line);
            }
        }
    }
    links
}

/// Whether some stage takes what the channel delivers: one that has heard of its receiver, or of nobody at all. States
/// cross both ways, so of them only a receiver that was heard of says which way leads there.
fn is_accounted(channel: &Channel, books: &Books) -> bool {
    let inputs = books.nodes.values().flat_map(|node| node.inputs.values());
    let mut takers = inputs.filter(|input| input.accounts.contains(&channel.kind));
    let one_way = channel.kind != Kind::AgentState;
    takers.any(|InputBooks { receivers, .. }| receivers.contains(&channel.to) || (one_way && receivers.is_empty()))
}

#[cfg(test)]
mod tests {
    use realo_operator::NodeBooks;
    use realo_schemas::report::Traffic;

    use super::*;
    use crate::Fates;

    fn channel(to: &str, kind: Kind, sent: u64) -> Channel {
        Channel {
            from: "rsu1".into(),
            to: to.into(),
            kind,
            traffic: Traffic {
                sent,
                bytes: 100 * sent,
                duplicated: 1,
                out_of_range: 2,
            },
        }
    }

    fn books(channels: &[Channel], accounts: &[Kind], receivers: &[&str]) -> Books {
        let link = NodeBooks {
            channels: channels.to_vec(),
            ..NodeBooks::default()
        };
        let input = InputBooks {
            accounts: accounts.to_vec(),
            receivers: receivers.iter().map(ToString::to_string).collect(),
            ..InputBooks::default()
        };
        let bank = NodeBooks {
            inputs: [("others".into(), input)].into(),
            ..NodeBooks::default()
        };
        Books {
            nodes: [("link".into(), link), ("bank".into(), bank)].into(),
        }
    }

    fn settled(used: u64, lost: u64) -> BTreeMap<ChannelKey, Settled> {
        let fates = Fates {
            used,
            ..Fates::default()
        };
        let key = ("rsu1".to_string(), "cav1".to_string(), Kind::Boxes);
        [(key, Settled { fates, lost })].into()
    }

    #[test]
    fn what_is_missing_or_too_much_is_reported() {
        for (used, expected) in [(8, 1), (9, 0), (10, -1)] {
            let books = books(&[channel("cav1", Kind::Boxes, 10)], &[Kind::Boxes], &["cav1"]);
            let links = link_books(&settled(used, 1), &books);
            let line = &links["rsu1-cav1"]["boxes"];
            assert_eq!(line.accounted.unwrap().unaccounted, expected);
            let numbers = (line.sent, line.bytes, line.lost, line.duplicated, line.out_of_range);
            assert_eq!(numbers, (10, 1000, 1, 1, 2));
        }
    }

    #[test]
    fn only_what_a_stage_takes_is_accounted_for() {
        let sent = [
            channel("cav1", Kind::Boxes, 1),
            channel("cav2", Kind::Boxes, 1),
            channel("cav1", Kind::AgentState, 1),
        ];
        let accounted = |receivers: &[&str]| {
            let links = link_books(&settled(1, 0), &books(&sent, &[Kind::Boxes], receivers));
            let of = |link: &str, kind: &str| links[link][kind].accounted.is_some();
            [
                of("rsu1-cav1", "boxes"),
                of("rsu1-cav2", "boxes"),
                of("rsu1-cav1", "agent_state"),
            ]
        };
        assert_eq!(accounted(&["cav1"]), [true, false, false]);
        assert_eq!(accounted(&[]), [true, true, false], "nothing came at all");
        let states = ["cav1", "rsu1"].map(|to| Channel {
            from: if to == "cav1" { "rsu1".into() } else { "cav1".into() },
            ..channel(to, Kind::AgentState, 1)
        });
        let accounted = |receivers: &[&str]| {
            let links = link_books(&BTreeMap::new(), &books(&states, &[Kind::AgentState], receivers));
            ["rsu1-cav1", "cav1-rsu1"].map(|link| links[link]["agent_state"].accounted.is_some())
        };
        assert_eq!(accounted(&["rsu1"]), [false, true]);
        assert_eq!(
            accounted(&[]),
            [false, false],
            "which way leads to a sender nobody has said"
        );
        let nobody = link_books(&settled(1, 0), &books(&sent, &[], &[]));
        let text = serde_json::to_string(&nobody["rsu1-cav1"]["boxes"]).unwrap();
        assert_eq!(
            text,
            "{\"sent\":1,\"bytes\":100,\"lost\":0,\"duplicated\":1,\"out_of_range\":2}"
        );
    }
}
