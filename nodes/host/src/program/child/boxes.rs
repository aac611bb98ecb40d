//! Boxes that a program sends, looked at where they come in.

use realo_operator::{Counter, Outputs};
use realo_schemas::geometry::detection_fault;
use realo_schemas::{Boxes, Message, Payload};

/// Counted under the program's node.
const REFUSED: Counter = Counter::loss(
    "refused_boxes",
    "boxes of a plug-in that were not taken: not finite, without extent or above 100 m, more than 10 km away, faster than 1,000 m/s, or \
     with a score outside [0, 1]",
    "boxes were not taken from the program of {node}, because no object can have such numbers",
    realo_schemas::plausible_detection!("correct the program"),
);

/// Takes boxes that no object can have out of a message, and counts them.
pub(super) fn take_out(message: &mut Message, out: &mut Outputs) {
    let Payload::Boxes(Boxes(boxes)) = &mut message.payload else {
        return;
    };
    let (agent, all) = (message.header.agent.clone(), boxes.len());
    let first = boxes.iter().find_map(detection_fault);
    boxes.retain(|object| detection_fault(object).is_none());
    out.count_of(&REFUSED, &agent, (all - boxes.len()) as u64, all as u64);
    if let Some(first) = first {
        out.found(&REFUSED, &agent, || format!("the first has {first}"));
    }
}

#[cfg(test)]
mod tests {
    use realo_schemas::{Box3, Header, Kind};

    use super::*;

    #[test]
    fn boxes_that_no_object_can_have_are_taken_out_and_counted() {
        let good = Box3::new("Car", [10.0, 0.0, 0.8], [4.0, 2.0, 1.6], 0.0);
        let scored = |score| Box3 { score, ..good.clone() };
        let at = |x| Box3 {
            center: [x, 0.0, 0.8],
            ..good.clone()
        };
        let fast = Box3 {
            velocity: Some([0.0, 2e3, 0.0]),
            ..good.clone()
        };
        let sent = vec![scored(2.0), good.clone(), scored(f32::NAN), at(f64::INFINITY), fast];
        let header = Header::origin(&"run".into(), &"cav1".into(), Kind::Boxes, 0, 0, 0);
        let mut message = Message::new(header, Boxes(sent));
        let mut out = Outputs::at(0);
        take_out(&mut message, &mut out);
        assert_eq!(message.payload, Boxes(vec![good]).into());
        let made = out.into_made();
        assert_eq!(made.counts.get("refused_boxes"), 4);
        let loss = &made.counts.losses["refused_boxes"];
        assert_eq!(
            (loss.agents["cav1"].of, &*loss.found["cav1"]),
            (5, "the first has a score of 2")
        );
    }
}
