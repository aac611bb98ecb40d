//! Joins what links, bank, fusion and stages counted into the books of every channel.

use std::collections::BTreeMap;

use realo_runtime::Books;
use realo_schemas::Kind;
use realo_schemas::report::Channel;

use crate::{Accounted, Fates, LinkBooks};

/// The books of all channels, by `<from>-<to>` and kind.
///
/// `fates`: by sender and kind, what bank and fusion did; `None` if not all of their reports reach the results. Only
/// what goes to the ego and is taken by a bank is accounted for.
pub fn link_books(
    channels: &[Channel],
    ego: &str,
    fates: Option<&BTreeMap<(String, Kind), Fates>>,
    books: &Books,
) -> BTreeMap<String, BTreeMap<String, LinkBooks>> {
    let mut links: BTreeMap<String, BTreeMap<String, LinkBooks>> = BTreeMap::new();
    for channel in channels {
        let fates = fates.filter(|_| channel.to == ego && channel.kind != Kind::EgoState);
        let accounted = fates.map(|fates| {
            let key = (channel.from.clone(), channel.kind);
            account(channel, fates.get(&key).copied().unwrap_or_default(), books)
        });
        let link = links.entry(format!("{}-{}", channel.from, channel.to)).or_default();
        let line = LinkBooks {
            sent: channel.sent,
            bytes: channel.bytes,
            lost: channel.lost,
            duplicated: channel.duplicated,
            out_of_range: channel.out_of_range,
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

/// What became of the messages of a channel: in bank and fusion, and in the stages before.
fn account(channel: &Channel, mut fates: Fates, books: &Books) -> Accounted {
    for input in books.nodes.values().flat_map(|node| node.inputs.values()) {
        let of = |tally: &realo_runtime::Tally| {
            let kinds = tally.0.get(&channel.from);
            kinds.and_then(|kinds| kinds.get(&channel.kind)).copied().unwrap_or(0)
        };
        fates.skipped += of(&input.delivered_skipped);
        fates.rejected += of(&input.delivered_rejected);
    }
    Accounted {
        fates,
        unaccounted: channel.sent as i64 - channel.lost as i64 - fates.total() as i64,
    }
}

#[cfg(test)]
mod tests {
    use realo_runtime::{InputBooks, NodeBooks, Tally};

    use super::*;

    fn channel(to: &str, kind: Kind, sent: u64, lost: u64, duplicated: u64) -> Channel {
        Channel {
            from: "rsu1".into(),
            to: to.into(),
            kind,
            sent,
            bytes: 100 * sent,
            lost,
            duplicated,
            out_of_range: 2,
        }
    }

    fn decoder(skipped: u64, rejected: u64) -> Books {
        let tally = |n| Tally([("rsu1".to_string(), [(Kind::Boxes, n)].into())].into());
        let packets = InputBooks {
            delivered_skipped: tally(skipped),
            delivered_rejected: tally(rejected),
            ..InputBooks::default()
        };
        let node = NodeBooks {
            inputs: [("packets".into(), packets)].into(),
            ..NodeBooks::default()
        };
        Books {
            nodes: [("decoder".into(), node)].into(),
        }
    }

    fn fates(used: u64, skipped: u64, in_flight: u64) -> BTreeMap<(String, Kind), Fates> {
        let fates = Fates {
            used,
            skipped,
            in_flight,
            ..Fates::default()
        };
        [(("rsu1".to_string(), Kind::Boxes), fates)].into()
    }

    #[test]
    fn terms_of_all_stages_add_up_to_what_was_sent() {
        let books = link_books(
            &[channel("cav1", Kind::Boxes, 20, 3, 0)],
            "cav1",
            Some(&fates(9, 2, 1)),
            &decoder(4, 1),
        );
        let books = &books["rsu1-cav1"]["boxes"];
        let Accounted { fates, unaccounted } = books.accounted.unwrap();
        assert_eq!(
            (fates.used, fates.skipped, fates.rejected, fates.in_flight),
            (9, 6, 1, 1)
        );
        assert_eq!(
            (books.sent, books.bytes, books.lost, books.out_of_range, unaccounted),
            (20, 2000, 3, 2, 0)
        );
    }

    #[test]
    fn what_is_missing_or_too_much_is_told() {
        for (used, expected) in [(8, 1), (9, 0), (10, -1)] {
            let sent = [channel("cav1", Kind::Boxes, 10, 1, 0)];
            let books = link_books(&sent, "cav1", Some(&fates(used, 0, 0)), &Books::default());
            assert_eq!(books["rsu1-cav1"]["boxes"].accounted.unwrap().unaccounted, expected);
        }
    }

    #[test]
    fn only_what_the_ego_fuses_is_accounted_for() {
        let sent = [
            channel("cav1", Kind::Boxes, 1, 0, 0),
            channel("cav2", Kind::Boxes, 1, 0, 0),
            channel("cav1", Kind::EgoState, 1, 0, 0),
        ];
        let books = link_books(&sent, "cav1", Some(&fates(1, 0, 0)), &Books::default());
        assert!(books["rsu1-cav1"]["boxes"].accounted.is_some());
        assert!(books["rsu1-cav1"]["ego_state"].accounted.is_none());
        assert!(books["rsu1-cav2"]["boxes"].accounted.is_none());
        let books = link_books(&sent, "cav1", None, &Books::default());
        assert!(books["rsu1-cav1"]["boxes"].accounted.is_none());
        let text = serde_json::to_string(&books["rsu1-cav1"]["boxes"]).unwrap();
        assert_eq!(
            text,
            "{\"sent\":1,\"bytes\":100,\"lost\":0,\"duplicated\":0,\"out_of_range\":2}"
        );
        assert_eq!(
            &serde_json::from_str::<LinkBooks>(&text).unwrap(),
            &books["rsu1-cav1"]["boxes"]
        );
    }
}
