//! A dora node that passes messages on, but drops, repeats and swaps some of them; for tests of what receivers notice.
//!
//! Of ten messages it drops the 4th, sends the 6th twice and the 8th behind what comes next; with `repeat` it only repeats. Writes
//! what it did to the file that its first argument names.

use dora_node_api::dora_core::config::DataId;
use dora_node_api::{DoraArray, DoraNode, Event};
use realo_schemas::{Payload, wire};

fn main() -> eyre::Result<()> {
    let report = std::env::args()
        .nth(1)
        .ok_or_else(|| eyre::eyre!("usage: tamper REPORT all|repeat"))?;
    let all = std::env::args().nth(2).as_deref() != Some("repeat");
    let (mut node, mut events) = DoraNode::init_from_env()?;
    let output = DataId::from("out".to_string());
    let (mut n, mut dropped, mut repeated, mut swapped) = (0u64, 0u64, 0u64, 0u64);
    let mut held: Option<DoraArray> = None;
    while let Some(event) = events.recv() {
        let Event::Input { data, metadata, .. } = event else {
            continue;
        };
        let behind = held.take();
        if is_packet(&data) {
            n += 1;
            match n % 10 {
                4 if all => dropped += 1,
                6 => {
                    repeated += 1;
                    node.send_output(output.clone(), Default::default(), data.clone())?;
                    node.send_output(output.clone(), Default::default(), data)?;
                }
                8 if all => {
                    swapped += 1;
                    held = Some(data);
                }
                _ => node.send_output(output.clone(), Default::default(), data)?,
            }
        } else {
            // Marks of the driver go through as they are. They are numbered like packets, so one of them may be the 9th.
            node.send_output(output.clone(), metadata.parameters, data)?;
        }
        if let Some(behind) = behind {
            node.send_output(output.clone(), Default::default(), behind)?;
        }
        std::fs::write(
            &report,
            format!("{{\"dropped\":{dropped},\"repeated\":{repeated},\"swapped\":{swapped}}}"),
        )?;
    }
    Ok(())
}

fn is_packet(data: &DoraArray) -> bool {
    wire::from_arrow(data.as_array().as_ref()).is_ok_and(|message| matches!(message.payload, Payload::Packet(_)))
}
