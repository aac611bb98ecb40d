use realo_operator::{Argument, Describe, Error, Operator, Outputs, Port, PortId, unexpected, wrong_port};
use realo_schemas::{EgoState, Header, Message, PayloadType, PointCloud, Pose, PoseStatus};
use serde::{Deserialize, Serialize};

const CLOUDS: PortId = PortId(0);
const STATES: PortId = PortId(1);
const OUT_CLOUDS: PortId = PortId(0);
const OUT_STATE: PortId = PortId(1);

/// Where poses come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Source {
    /// As the log gives them, whatever their status.
    #[default]
    Recorded,
    /// True ones; any other is an error.
    True,
}

/// Settings of localization.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LocalizationConfig {
    /// Where poses come from.
    pub source: Source,
}

/// The state of an agent at a sweep, from what is known before.
///
/// # Errors
/// If true poses are asked for and the state is not one.
pub fn localize(source: Source, prior: EgoState) -> Result<EgoState, Error> {
    if source == Source::True && prior.status != PoseStatus::Truth {
        let found = prior.status;
        return Err(format!("argument `source`: expected true poses, found one that is {found:?}; play the log's true poses, or set source=recorded").into());
    }
    Ok(prior)
}

/// Says where each agent is at each sweep.
pub struct Localization {
    source: Source,
    /// The sweep whose state comes next.
    sweep: Option<(Header, PointCloud)>,
}

impl Describe for Localization {
    type Config = LocalizationConfig;
    const NAME: &'static str = "localization";
    const ABOUT: &'static str = "Says where each agent is at each sweep: the pose that the log gives";
    const ARGUMENTS: &'static [Argument] = &[Argument {
        name: "source",
        about: "recorded (as the log gives them) or true (refuses any other)",
    }];
    const INPUTS: &'static [Port] = &[
        Port::new(
            "clouds",
            &[PayloadType::PointCloud],
            "sweeps in the body frame at their stamp",
        )
        .latest()
        .joined("sweep"),
        Port::new(
            "states",
            &[PayloadType::EgoState],
            "what is known of pose and motion then",
        )
        .latest()
        .joined("sweep"),
    ];
    const OUTPUTS: &'static [Port] = &[
        Port::new(
            "clouds",
            &[PayloadType::PointCloud],
            "the sweeps with the estimated pose",
        ),
        Port::new(
            "state",
            &[PayloadType::EgoState],
            "the estimated pose and motion at the sweep's stamp",
        ),
    ];
}

impl Operator for Localization {
    fn new(config: LocalizationConfig) -> Result<Self, Error> {
        Ok(Localization {
            source: config.source,
            sweep: None,
        })
    }

    fn on_input(&mut self, port: PortId, message: Message, out: &mut Outputs) -> Result<(), Error> {
        match port {
            CLOUDS => self.sweep = Some(message.into_parts().map_err(unexpected)?),
            STATES => {
                let (state_header, prior): (Header, EgoState) = message.into_parts().map_err(unexpected)?;
                let sweep = self.sweep.take();
                let same = |(header, _): &(Header, PointCloud)| {
                    (&header.agent, header.seq, header.stamp)
                        == (&state_header.agent, state_header.seq, state_header.stamp)
                };
                let (cloud_header, cloud) = sweep.filter(same).ok_or("a state whose sweep did not come before it")?;
                let state = localize(self.source, prior)?;
                let pose = Pose {
                    map_from_frame: state.map_from_body,
                    covariance: state.covariance.clone(),
                };
                out.send(
                    OUT_STATE,
                    Message::new(
                        Header {
                            pose: Some(pose.clone()),
                            ..state_header
                        },
                        state,
                    ),
                );
                out.send(
                    OUT_CLOUDS,
                    Message::new(
                        Header {
                            pose: Some(pose),
                            ..cloud_header
                        },
                        cloud,
                    ),
                );
            }
            _ => return Err(wrong_port(Self::INPUTS, port)),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Isometry3;
    use realo_schemas::Kind;

    use super::*;

    fn header(kind: Kind, seq: u64) -> Header {
        Header::origin(&"run".into(), &"cav1".into(), kind, seq, 100, 150)
    }

    fn cloud(seq: u64) -> Message {
        Message::new(header(Kind::Points, seq), PointCloud::empty())
    }

    fn state(seq: u64, status: PoseStatus) -> Message {
        let state = EgoState {
            map_from_body: Isometry3::translation(1.0, 2.0, 3.0),
            covariance: Some(Box::new([0.5; 36])),
            velocity: None,
            angular_rate: None,
            status,
        };
        Message::new(header(Kind::EgoState, seq), state)
    }

    #[test]
    fn passes_the_pose_into_the_sweep() {
        let mut localization = Localization::new(LocalizationConfig::default()).unwrap();
        let mut out = Outputs::at(150);
        localization.on_input(CLOUDS, cloud(4), &mut out).unwrap();
        assert_eq!(out.take_sent(), []);
        localization
            .on_input(STATES, state(4, PoseStatus::Extrapolated), &mut out)
            .unwrap();
        let sent = out.take_sent();
        let pose = Pose {
            map_from_frame: Isometry3::translation(1.0, 2.0, 3.0),
            covariance: Some(Box::new([0.5; 36])),
        };
        assert_eq!(sent.len(), 2);
        assert_eq!(
            (sent[0].0, sent[0].1.header.kind, sent[0].1.header.pose.as_ref()),
            (OUT_STATE, Kind::EgoState, Some(&pose))
        );
        assert_eq!(
            (sent[1].0, sent[1].1.header.kind, sent[1].1.header.pose.as_ref()),
            (OUT_CLOUDS, Kind::Points, Some(&pose))
        );
        assert_eq!(sent[0].1.payload, state(4, PoseStatus::Extrapolated).payload);
    }

    #[test]
    fn refuses_what_is_not_true_when_truth_is_asked_for() {
        let mut localization = Localization::new(LocalizationConfig { source: Source::True }).unwrap();
        let mut out = Outputs::at(150);
        localization.on_input(CLOUDS, cloud(4), &mut out).unwrap();
        let error = localization
            .on_input(STATES, state(4, PoseStatus::Recorded), &mut out)
            .unwrap_err()
            .to_string();
        assert!(error.contains("`source`") && error.contains("Recorded"), "{error}");
        localization.on_input(CLOUDS, cloud(5), &mut out).unwrap();
        localization
            .on_input(STATES, state(5, PoseStatus::Truth), &mut out)
            .unwrap();
        assert_eq!(out.take_sent().len(), 2);
    }

    #[test]
    fn refuses_a_state_of_another_sweep() {
        let mut localization = Localization::new(LocalizationConfig::default()).unwrap();
        let mut out = Outputs::at(150);
        assert!(
            localization
                .on_input(STATES, state(4, PoseStatus::Truth), &mut out)
                .is_err()
        );
        localization.on_input(CLOUDS, cloud(4), &mut out).unwrap();
        assert!(
            localization
                .on_input(STATES, state(5, PoseStatus::Truth), &mut out)
                .is_err()
        );
        assert_eq!(out.take_sent(), []);
    }

    #[test]
    fn arguments_are_the_keys_of_the_configuration() {
        let keys: Vec<String> = realo_operator::config::defaults::<LocalizationConfig>()
            .keys()
            .cloned()
            .collect();
        assert_eq!(
            keys,
            Localization::ARGUMENTS
                .iter()
                .map(|argument| argument.name)
                .collect::<Vec<_>>()
        );
    }
}
