use std::sync::OnceLock;

use realo_operator::{Registration, Registry};

/// Every operator and node that realo ships, in the order of a frame's way.
const SHIPPED: &[Registration] = &[
    Registration::source::<realo_player::Player>(),
    Registration::operator::<realo_stages::Sync>(),
    Registration::operator::<realo_stages::Localization>(),
    Registration::operator::<realo_stages::RecordedDetections>(),
    Registration::operator::<realo_stages::Projector>(),
    Registration::operator::<realo_pillar_encoder::PillarEncoder>(),
    Registration::operator::<realo_detection_head::DetectionHead>(),
    Registration::operator::<realo_stages::Nms>(),
    Registration::operator::<realo_stages::Tracker>(),
    Registration::operator::<realo_stages::Liar>(),
    Registration::operator::<realo_stages::TransmissionEncoder>(),
    Registration::operator::<realo_stages::Link>(),
    Registration::gateway::<realo_radio::Radio>(),
    Registration::operator::<realo_stages::TransmissionDecoder>(),
    Registration::operator::<realo_stages::FeatureBank>(),
    Registration::operator::<realo_stages::FusionGuard>(),
    Registration::operator::<realo_fusion_features::FusionFeatures>(),
    Registration::operator::<realo_fusion_points::FusionPoints>(),
    Registration::operator::<realo_fusion_boxes::FusionBoxes>(),
    Registration::operator::<realo_stages::Evaluator>(),
    Registration::sink::<realo_recorder::Recorder>(),
    Registration::sink::<realo_recorder::LogRecorder>(),
    Registration::sink::<realo_results::Results>(),
];

static ALL: OnceLock<Vec<Registration>> = OnceLock::new();

/// Every operator and node that this binary hosts: those that are shipped, and those of [`crate::main_with`].
pub fn registry() -> Registry {
    Registry(ALL.get_or_init(|| SHIPPED.to_vec()))
}

/// Adds operators and nodes; those of a shipped name take its place.
pub(crate) fn register(own: &[Registration]) {
    let shipped = SHIPPED.iter().filter(|shipped| {
        !own.iter()
            .any(|own| (own.word(), own.name) == (shipped.word(), shipped.name))
    });
    // Whoever asks for the registry before has none of `own`; `main_with` registers first.
    let _ = ALL.set(shipped.chain(own).copied().collect());
}
