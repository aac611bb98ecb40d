//! The stages, one for each role.

use realo_bev::counters::{EMPTY_SWEEPS, OVER_LIMIT_BOXES, OVER_POINTS, count_empty};
use realo_fusion::{Input as FusionInput, Pairing};
use realo_operator::{Counter, Describe, Error, Inputs, KnownMap, Operator, Outputs, Settings};
use realo_schemas::{Boxes, FeatureMap, Header, Kind, PointCloud};
use serde::{Deserialize, Serialize};

use crate::boxes::{self, Decoder, Detections, INVALID_BOXES};
use crate::cloud::{self, Cloud, OUT_OF_RANGE_POINTS, OVER_PILLARS, Reader, Sweep};
use crate::maps::{self, FEATURES, MAPS, MASK};
use crate::network::{Input as Tensor, Network, Onnx};
use crate::role::Role;

/// Sweeps of any agent.
#[derive(Debug, Inputs)]
pub enum Sweeps {
    /// Sweeps in the agent's body frame.
    #[port(latest)]
    Clouds(Header, PointCloud),
}

/// Maps for the head.
#[derive(Debug, Inputs)]
pub enum Maps {
    /// Maps in the ego's frame.
    #[port(latest)]
    Features(Header, FeatureMap),
}

/// What an encoder sends.
#[derive(Debug, Outputs)]
pub enum Encoded {
    /// BEV maps as agents share them.
    Features(Header, FeatureMap),
    /// BEV maps for the agent's own fusion.
    Own(Header, FeatureMap),
}

/// What a fusion sends.
#[derive(Debug, Outputs)]
pub enum Fused {
    /// One map for the head, in the ego's frame.
    Features(Header, FeatureMap),
}

/// What a head or a detector sends.
#[derive(Debug, Outputs)]
pub enum Found {
    /// Detections, best first.
    Proposals(Header, Boxes),
}

/// Settings of [`Encoder`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct EncoderSettings {
    /// `encoder`.
    pub role: Role,
    /// The file.
    #[setting(flatten)]
    #[serde(flatten)]
    pub onnx: Onnx,
    /// The points.
    #[setting(flatten)]
    #[serde(flatten)]
    pub cloud: Cloud,
    /// Which outputs maps go to: `both`, `own` (with the ego) or `features` (across the link).
    pub send: Send,
}

/// Which outputs maps go to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Send {
    /// To both.
    #[default]
    Both,
    /// To the ego's own fusion alone.
    Own,
    /// To others alone.
    Features,
}

/// Makes BEV maps of sweeps by an ONNX file.
#[derive(Describe)]
#[stage(name = "onnx-encoder", settings = EncoderSettings, input = Sweeps, output = Encoded, counters = cloud::COUNTERS, maps = encoder_maps)]
pub struct Encoder {
    network: Network,
    reader: Reader,
    range: [f64; 6],
    send: Send,
}

/// Sizes of maps that files fix; what cannot be loaded is said by `build`.
type Sizes = Vec<(&'static str, KnownMap)>;

fn encoder_maps(settings: &EncoderSettings) -> Sizes {
    Network::look(&settings.onnx, cloud::INPUTS, &[FEATURES], |network| {
        let made = network.known_output(FEATURES.name);
        vec![("features", made.clone()), ("own", made)]
    })
}

impl Operator for Encoder {
    fn build(settings: EncoderSettings) -> Result<Self, Error> {
        let network = Network::load(&settings.onnx, cloud::INPUTS, &[FEATURES])?;
        Ok(Encoder {
            range: settings.cloud.range,
            reader: Reader::of(&network, settings.cloud)?,
            send: settings.send,
            network,
        })
    }

    fn on_input(&mut self, input: Sweeps, out: &mut Outputs<Encoded>) -> Result<(), Error> {
        let Sweeps::Clouds(header, cloud) = input;
        let inputs = read(&mut self.reader, &header, &cloud, out);
        let [features] = self.network.run(inputs, [FEATURES.name])?;
        let (size, planes) = self.network.plain(&FEATURES, features)?;
        let map = maps::of_sweep(&self.network, size, &planes, self.range)?;
        let header = Header {
            kind: Kind::Features,
            ..header
        };
        if self.send != Send::Features {
            out.send(Encoded::Own(header.clone(), map.clone()));
        }
        if self.send != Send::Own {
            out.send(Encoded::Features(header, map));
        }
        Ok(())
    }
}

/// The inputs of a sweep, with what was left out of it counted.
fn read<O>(
    reader: &mut Reader,
    header: &Header,
    cloud: &PointCloud,
    out: &mut Outputs<O>,
) -> Vec<(&'static str, Tensor)> {
    let Sweep {
        inputs,
        dropped,
        is_empty,
    } = reader.read(cloud);
    let agent = &header.agent;
    count_empty(out, agent, cloud.len(), is_empty);
    out.count(&OUT_OF_RANGE_POINTS, agent, dropped.out_of_range + dropped.not_finite);
    out.count(&OVER_POINTS, agent, dropped.over_points);
    out.count_of(&OVER_PILLARS, agent, dropped.over_pillars, cloud.len() as u64);
    inputs
}

/// Settings of [`Fusion`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct FusionSettings {
    /// `fusion`.
    pub role: Role,
    /// The file.
    #[setting(flatten)]
    #[serde(flatten)]
    pub onnx: Onnx,
    /// Collaborators that a fusion takes, the nearest to the ego; null: as many as the file takes.
    pub max_collaborators: Option<usize>,
}

/// Fuses BEV maps by an ONNX file.
#[derive(Describe)]
#[stage(name = "onnx-fusion", settings = FusionSettings, input = FusionInput<FeatureMap>, output = Fused, counters = realo_fusion::COUNTERS, maps = fusion_maps)]
pub struct Fusion {
    network: Network,
    /// Agents, the ego included, of which the file takes exactly so many.
    agents: Option<usize>,
    limit: Option<usize>,
    pairing: Pairing<FeatureMap>,
}

fn fusion_maps(settings: &FusionSettings) -> Sizes {
    Network::look(&settings.onnx, &[MAPS, MASK], &[FEATURES], |network| {
        let taken = network.known_input(MAPS.name);
        vec![
            ("ego", taken.clone()),
            ("selections", taken),
            ("features", network.known_output(FEATURES.name)),
        ]
    })
}

impl Operator for Fusion {
    fn build(settings: FusionSettings) -> Result<Self, Error> {
        let network = Network::load(&settings.onnx, &[MAPS, MASK], &[FEATURES])?;
        let agents = network.fixed_input(MAPS.name, 3);
        if let Some(agents) = agents
            && !network.takes(MASK.name)
        {
            let reason = format!(
                "expected {MASK} beside {MAPS} for exactly {agents}, for how many are there changes: export `maps` with a dynamic \
                 dimension, or add `mask`"
            );
            return Err(network.input_error(reason).into());
        }
        let most = agents.map(|agents| agents.saturating_sub(1));
        Ok(Fusion {
            limit: settings.max_collaborators.into_iter().chain(most).min(),
            network,
            agents,
            pairing: Pairing::default(),
        })
    }

    fn on_input(&mut self, input: FusionInput<FeatureMap>, out: &mut Outputs<Fused>) -> Result<(), Error> {
        let Some(mut set) = self.pairing.take(input, self.limit)? else {
            return Ok(());
        };
        let maps = set.maps()?;
        let [rows, columns, _] = maps.size;
        let inputs = maps::placed(&maps, self.agents.unwrap_or(1 + maps.others.len()));
        let [fused] = self.network.run(inputs.into(), [FEATURES.name])?;
        let (size, planes) = self.network.plain(&FEATURES, fused)?;
        if size[1..] != [rows, columns] {
            let found =
                format!("expected {FEATURES} of {rows} rows and {columns} columns, as the ego's map, found {size:?}");
            return Err(self.network.output_error(found).into());
        }
        let fused = FeatureMap {
            channels: size[0] as u32,
            ..set.ego.clone()
        };
        let fused = fused.with_numbers(maps::cells(&planes, size));
        set.send(Fused::Features, fused, out);
        Ok(())
    }
}

/// Settings of [`Head`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct HeadSettings {
    /// `head`.
    pub role: Role,
    /// The file.
    #[setting(flatten)]
    #[serde(flatten)]
    pub onnx: Onnx,
    /// The boxes.
    #[setting(flatten)]
    #[serde(flatten)]
    pub detections: Detections,
    /// Height of the LiDAR above the ground, m, for a network whose z counts from it.
    #[setting(range = -10.0..=10.0)]
    pub lidar_height: f64,
}

/// Finds boxes in BEV maps by an ONNX file.
#[derive(Describe)]
#[stage(name = "onnx-head", settings = HeadSettings, input = Maps, output = Found, counters = boxes::COUNTERS, maps = head_maps)]
pub struct Head {
    network: Network,
    decoder: Decoder,
}

fn head_maps(settings: &HeadSettings) -> Sizes {
    Network::look(&settings.onnx, &[FEATURES], boxes::OUTPUTS, |network| {
        vec![("features", network.known_input(FEATURES.name))]
    })
}

impl Operator for Head {
    fn build(settings: HeadSettings) -> Result<Self, Error> {
        let network = Network::load(&settings.onnx, &[FEATURES], boxes::OUTPUTS)?;
        Ok(Head {
            decoder: Decoder::of(&network, settings.detections, settings.lidar_height)?,
            network,
        })
    }

    fn on_input(&mut self, input: Maps, out: &mut Outputs<Found>) -> Result<(), Error> {
        let Maps::Features(header, map) = input;
        let [rows, columns, channels] = map.size();
        let planes = maps::planes(&map.numbers()?, map.size());
        let features = Tensor::floats(&[1, channels, rows, columns], planes);
        find(
            &self.network,
            &self.decoder,
            header,
            vec![(FEATURES.name, features)],
            out,
        )
    }
}

/// Settings of [`Detector`].
#[derive(Clone, Debug, PartialEq, Settings, Serialize, Deserialize)]
pub struct DetectorSettings {
    /// `detector`.
    pub role: Role,
    /// The file.
    #[setting(flatten)]
    #[serde(flatten)]
    pub onnx: Onnx,
    /// The points.
    #[setting(flatten)]
    #[serde(flatten)]
    pub cloud: Cloud,
    /// The boxes.
    #[setting(flatten)]
    #[serde(flatten)]
    pub detections: Detections,
}

const DETECTOR_COUNTERS: &[Counter] = &[
    EMPTY_SWEEPS,
    OUT_OF_RANGE_POINTS,
    OVER_POINTS,
    OVER_PILLARS,
    OVER_LIMIT_BOXES,
    INVALID_BOXES,
];

/// Finds boxes in sweeps by an ONNX file.
#[derive(Describe)]
#[stage(name = "onnx-detector", settings = DetectorSettings, input = Sweeps, output = Found, counters = DETECTOR_COUNTERS)]
pub struct Detector {
    network: Network,
    reader: Reader,
    decoder: Decoder,
}

impl Operator for Detector {
    fn build(settings: DetectorSettings) -> Result<Self, Error> {
        let network = Network::load(&settings.onnx, cloud::INPUTS, boxes::OUTPUTS)?;
        Ok(Detector {
            decoder: Decoder::of(&network, settings.detections, settings.cloud.lidar_height)?,
            reader: Reader::of(&network, settings.cloud)?,
            network,
        })
    }

    fn on_input(&mut self, input: Sweeps, out: &mut Outputs<Found>) -> Result<(), Error> {
        let Sweeps::Clouds(header, cloud) = input;
        let inputs = read(&mut self.reader, &header, &cloud, out);
        find(&self.network, &self.decoder, header, inputs, out)
    }
}

/// Sends the boxes that a network finds.
fn find(
    network: &Network,
    decoder: &Decoder,
    header: Header,
    inputs: Vec<(&'static str, Tensor)>,
    out: &mut Outputs<Found>,
) -> Result<(), Error> {
    let [found, scores] = network.run(inputs, [boxes::BOXES.name, boxes::SCORES.name])?;
    let found = network.plain(&boxes::BOXES, found)?;
    let scores = network.plain(&boxes::SCORES, scores)?;
    let decoded = decoder.decode(network, found, scores)?;
    let all = decoded.boxes.0.len() as u64 + decoded.over_limit + decoded.invalid;
    out.count(&OVER_LIMIT_BOXES, &header.agent, decoded.over_limit);
    out.count_of(&INVALID_BOXES, &header.agent, decoded.invalid, all);
    let header = Header {
        kind: Kind::Boxes,
        ..header
    };
    out.send(Found::Proposals(header, decoded.boxes));
    Ok(())
}
