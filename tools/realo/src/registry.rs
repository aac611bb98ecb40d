use realo_runtime::{Registration, Registry};

/// Every operator and node that this binary hosts, in the order of a frame's way.
pub static REGISTRY: Registry = Registry(&[
    Registration::source::<realo_player::Player>(),
    Registration::operator::<realo_sync::Sync>(),
    Registration::operator::<realo_localization::Localization>(),
    Registration::operator::<realo_recorded_detections::RecordedDetections>(),
    Registration::operator::<realo_pillar_encoder::PillarEncoder>(),
    Registration::operator::<realo_detection_head::DetectionHead>(),
    Registration::operator::<realo_nms::Nms>(),
    Registration::operator::<realo_transmission::TransmissionEncoder>(),
    Registration::operator::<realo_link::Link>(),
    Registration::operator::<realo_transmission::TransmissionDecoder>(),
    Registration::operator::<realo_feature_bank::FeatureBank>(),
    Registration::operator::<realo_fusion_points::FusionPoints>(),
    Registration::operator::<realo_fusion_boxes::FusionBoxes>(),
    Registration::operator::<realo_evaluator::Evaluator>(),
    Registration::sink::<realo_recorder::Recorder>(),
    Registration::sink::<realo_results::Results>(),
]);
