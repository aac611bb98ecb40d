//! The checks by fusions that hold all of them, and by some that break one.

use std::panic::{AssertUnwindSafe, catch_unwind};

use realo_operator::{Describe, Error, Port, PortError, Settings, StageInputs};
use realo_schemas::{Box3, Boxes, Kind, Report};
use serde::{Deserialize, Serialize};

use super::*;

// What a toy does wrong.
const NOTHING: usize = 0;
const TAKES_ENTRIES_AS_THEY_STAND: usize = 1;
const FORGETS_THE_EGO_ALONE: usize = 2;
const IS_SILENT_WITHOUT_ENTRIES: usize = 3;
const FUSES_WITHOUT_A_POSE: usize = 4;
const JOINS_NOTHING: usize = 5;
const FUSES_ANY_QUERY: usize = 6;
const WAKES_FOR_EVER: usize = 7;
const FAILS_WHEN_WOKEN: usize = 8;
const ANSWERS_AGAIN_AT_THE_END: usize = 9;
const MOVES_THE_STAMP: usize = 10;
const NAMES_A_COLLABORATOR: usize = 11;
const SAYS_NOTHING_OF_RSU1: usize = 12;
const SAYS_NOTHING_OF_THE_FIRST_SET: usize = 13;
const USES_WITHOUT_A_POSE: usize = 14;

const ANY: &[PayloadType] = &[PayloadType::Boxes, PayloadType::Selection];
const JOINED: &[Port] = &[
    Port::new("ego", ANY, "").joined("frame"),
    Port::new("selections", ANY, "").joined("frame"),
];
const LOOSE: &[Port] = &[Port::new("ego", ANY, ""), Port::new("selections", ANY, "")];

/// Lists the boxes of the ego, then those of the collaborators by name; a report comes before.
struct Toy<const FLAW: usize> {
    ego: Option<Message>,
    last: Option<Message>,
}

/// Nothing is to be set.
#[derive(Settings, Serialize, Deserialize)]
struct Nothing {}

/// What comes in, joined or not.
struct Input<const FLAW: usize>(PortId, Message);

impl<const FLAW: usize> StageInputs for Input<FLAW> {
    const PORTS: &'static [Port] = if FLAW == JOINS_NOTHING { LOOSE } else { JOINED };

    fn read(port: PortId, message: Message) -> Result<Self, PortError> {
        Ok(Input(port, message))
    }
}

/// What it sends.
#[derive(Outputs)]
enum Output {
    /// What it has to say.
    Said(Header, Report),
    /// What it fused.
    #[port(any_of(Boxes))]
    Fused(Message),
}

impl<const FLAW: usize> Describe for Toy<FLAW> {
    type Settings = Nothing;
    type Input = Input<FLAW>;
    type Output = Output;
    const NAME: &'static str = "toy";
    const ABOUT: &'static str = "";
}

impl<const FLAW: usize> Toy<FLAW> {
    fn fuse(&mut self, selection: Message, out: &mut Outputs<Output>) -> Result<(), Error> {
        let (_, Selection { query, mut entries }) = selection.into_parts()?;
        let ego = self.ego.take().ok_or("no message of the ego")?;
        if FLAW != FUSES_ANY_QUERY && ego.header.seq != query {
            return Err("another query".into());
        }
        if FLAW != TAKES_ENTRIES_AS_THEY_STAND {
            entries.sort_by(|a, b| a.header.agent.cmp(&b.header.agent));
        }
        if FLAW == IS_SILENT_WITHOUT_ENTRIES && entries.is_empty() {
            return Ok(());
        }
        let (mut header, Boxes(mut fused)) = ego.into_parts()?;
        if FLAW == FORGETS_THE_EGO_ALONE && entries.is_empty() {
            fused.clear();
        }
        for entry in entries {
            let (of, Boxes(boxes)) = entry.into_parts()?;
            let silent = match FLAW {
                SAYS_NOTHING_OF_RSU1 => &*of.agent == "rsu1",
                SAYS_NOTHING_OF_THE_FIRST_SET => of.seq == 0,
                _ => false,
            };
            let placed = of.pose.is_some();
            match placed || FLAW == USES_WITHOUT_A_POSE {
                _ if silent => {}
                true => out.used(&of, &header),
                false => out.report(&of, Fate::Rejected),
            }
            if placed || FLAW == FUSES_WITHOUT_A_POSE {
                fused.extend(boxes);
            }
            if FLAW == NAMES_A_COLLABORATOR {
                header.agent = of.agent;
            }
        }
        if FLAW == MOVES_THE_STAMP {
            header.stamp += 1;
        }
        let report = Report {
            topic: "said".into(),
            json: "{}".into(),
        };
        let fused = Message::new(header, Boxes(fused));
        self.last = Some(fused.clone());
        out.send(Output::Said(fused.header.clone(), report));
        out.send(Output::Fused(fused));
        Ok(())
    }
}

impl<const FLAW: usize> Operator for Toy<FLAW> {
    fn build(_: Nothing) -> Result<Self, Error> {
        Ok(Toy { ego: None, last: None })
    }

    fn on_input(&mut self, Input(port, message): Input<FLAW>, out: &mut Outputs<Output>) -> Result<(), Error> {
        out.wake_at(out.now() + 5);
        match port {
            PortId(0) => self.ego = Some(message),
            _ => self.fuse(message, out)?,
        }
        Ok(())
    }

    fn on_wake(&mut self, now: Nanos, out: &mut Outputs<Output>) -> Result<(), Error> {
        match FLAW {
            WAKES_FOR_EVER => out.wake_at(now + 1),
            FAILS_WHEN_WOKEN => return Err("tired".into()),
            _ => {}
        }
        Ok(())
    }

    fn on_end(&mut self, out: &mut Outputs<Output>) -> Result<(), Error> {
        if FLAW == ANSWERS_AGAIN_AT_THE_END {
            out.send(Output::Fused(self.last.take().ok_or("nothing to answer")?));
        }
        Ok(())
    }
}

/// A message of one box at `x`, with a pose, measured at 60 ns and ready at 80.
fn boxes(agent: &str, x: f64) -> Message {
    let mut header = Header::origin(&"run".into(), &agent.into(), Kind::Boxes, 3, 60, 80);
    header.pose = Some(realo_schemas::Pose::exact(Default::default()));
    let object = Box3 {
        center: [x, 0.0, 0.0],
        length: 4.0,
        width: 2.0,
        height: 1.5,
        yaw: 0.0,
        velocity: None,
        class: "Car".into(),
        score: 0.5,
        track: None,
        covariance: None,
    };
    Message::new(header, Boxes(vec![object]))
}

fn case() -> FusionCase {
    let ego = boxes("cav1", 1.0);
    FusionCase {
        args: vec![],
        alone: ego.payload.clone(),
        ego,
        entries: vec![boxes("cav2", 2.0), boxes("rsu1", 3.0)],
    }
}

/// What a check says of a case that does not hold it.
type Refused = fn(&FusionCase) -> String;

fn refused<O: Operator + Send + 'static>(case: &FusionCase) -> String {
    let panic = catch_unwind(AssertUnwindSafe(|| case.check::<O>())).expect_err("every check is held");
    match panic.downcast::<String>() {
        Ok(text) => *text,
        Err(panic) => panic.downcast::<&str>().expect("a text").to_string(),
    }
}

#[test]
fn a_fusion_without_a_flaw_holds_every_check() {
    case().check::<Toy<NOTHING>>();
}

#[test]
fn each_flaw_is_named() {
    let cases: [(Refused, &str); 14] = [
        (
            refused::<Toy<TAKES_ENTRIES_AS_THEY_STAND>>,
            "entries in the order rsu1, cav2",
        ),
        (
            refused::<Toy<FORGETS_THE_EGO_ALONE>>,
            "no entry: expected what the ego alone gives",
        ),
        (
            refused::<Toy<IS_SILENT_WITHOUT_ENTRIES>>,
            "no entry: one message for one query",
        ),
        (
            refused::<Toy<FUSES_WITHOUT_A_POSE>>,
            "entries without a pose: expected what the ego alone gives",
        ),
        (
            refused::<Toy<USES_WITHOUT_A_POSE>>,
            "entries without a pose: nothing was used",
        ),
        (refused::<Toy<JOINS_NOTHING>>, "the same set again"),
        (
            refused::<Toy<FUSES_ANY_QUERY>>,
            "a selection for query 5 was fused with the ego's message 6",
        ),
        (
            refused::<Toy<WAKES_FOR_EVER>>,
            "after the last input 10000 wakes followed: the stream does not end",
        ),
        (refused::<Toy<FAILS_WHEN_WOKEN>>, "calls that failed"),
        (
            refused::<Toy<ANSWERS_AGAIN_AT_THE_END>>,
            "each query is answered once, in order",
        ),
        (refused::<Toy<MOVES_THE_STAMP>>, "the header is the ego's"),
        (refused::<Toy<NAMES_A_COLLABORATOR>>, "the header is the ego's"),
        (refused::<Toy<SAYS_NOTHING_OF_RSU1>>, "what became of message 0 of rsu1"),
        (
            refused::<Toy<SAYS_NOTHING_OF_THE_FIRST_SET>>,
            "what became of message 0 of cav2",
        ),
    ];
    for (refused, expected) in cases {
        let said = refused(&case());
        assert!(said.contains(expected), "expected `{expected}`, found: {said}");
    }
}

#[test]
fn a_case_needs_two_collaborators() {
    let mut alone = case();
    alone.entries.pop();
    assert!(refused::<Toy<NOTHING>>(&alone).contains("at least two collaborators"));
}

#[test]
fn sets_follow_each_other_by_a_period() {
    let case = case();
    for (seq, by) in [(0, 0), (1, 100_000_000), (6, 600_000_000)] {
        let [(ego, own), (selections, answer)] = case.set(seq, case.entries.clone());
        assert_eq!((ego, selections), ("ego", "selections"));
        let of = |header: &Header| (header.seq, header.stamp, header.ready);
        let expected = (seq, 60 + by, 80 + by);
        assert_eq!((of(&own.header), of(&answer.header)), (expected, expected));
        let (_, Selection { query, entries }) = answer.into_parts().unwrap();
        assert_eq!((query, entries.len()), (seq, 2));
        for entry in &entries {
            assert_eq!(
                (of(&entry.header), entry.header.to.as_deref()),
                (expected, Some("cav1"))
            );
        }
    }
}
