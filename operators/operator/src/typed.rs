use realo_schemas::{
    AgentState, Boxes, FeatureMap, GroundTruth, Header, Message, Motion, Packet, PayloadType, PointCloud, Report,
    Selection, UnexpectedPayload,
};

use crate::{Port, PortId};

/// A message that an operator cannot take.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    /// No port has this number.
    #[error("a message on port number {port}, this operator has {ports}")]
    Unknown {
        /// The number.
        port: usize,
        /// Ports that there are.
        ports: usize,
    },
    /// Its payload is not the port's.
    #[error(transparent)]
    Payload(#[from] UnexpectedPayload),
}

impl PortError {
    /// A port that is not one of `ports`.
    pub fn unknown(ports: &[Port], PortId(port): PortId) -> Self {
        let ports = ports.len();
        PortError::Unknown { port, ports }
    }
}

/// The inputs of a stage; `#[derive(Inputs)]` makes it from an enum with a variant for each port.
pub trait StageInputs: Sized {
    /// The ports, in priority order.
    const PORTS: &'static [Port];

    /// Takes apart a message of a port.
    ///
    /// # Errors
    /// Another payload than the port's, or a port that is not there.
    fn read(port: PortId, message: Message) -> Result<Self, PortError>;
}

/// The outputs of a stage; `#[derive(Outputs)]` makes it from an enum with a variant for each port.
pub trait StageOutputs {
    /// The ports.
    const PORTS: &'static [Port];

    /// The message, and the port on which it goes.
    fn into_message(self) -> (PortId, Message);
}

/// The inputs of a source.
#[derive(Debug)]
pub enum NoInput {}

impl StageInputs for NoInput {
    const PORTS: &'static [Port] = &[];

    fn read(port: PortId, _: Message) -> Result<Self, PortError> {
        Err(PortError::unknown(Self::PORTS, port))
    }
}

/// The outputs of a sink.
#[derive(Debug)]
pub enum NoOutput {}

impl StageOutputs for NoOutput {
    const PORTS: &'static [Port] = &[];

    fn into_message(self) -> (PortId, Message) {
        match self {}
    }
}

/// A payload that a port may carry.
pub trait PortPayload: Sized {
    /// Its type, alone.
    const TYPES: &'static [PayloadType];

    /// Takes a message of it apart.
    ///
    /// # Errors
    /// [`UnexpectedPayload`] if it carries another type.
    fn of_message(message: Message) -> Result<(Header, Self), UnexpectedPayload>;
}

macro_rules! payloads {
    ($($payload:ident),*) => {
        $(impl PortPayload for $payload {
            const TYPES: &'static [PayloadType] = &[PayloadType::$payload];

            fn of_message(message: Message) -> Result<(Header, Self), UnexpectedPayload> {
                message.into_parts()
            }
        })*
    };
}

payloads!(
    PointCloud,
    AgentState,
    FeatureMap,
    Packet,
    Selection,
    Report,
    Boxes,
    GroundTruth,
    Motion
);

#[cfg(test)]
mod tests {
    use realo_schemas::{Box3, Kind};

    use super::*;
    use crate::{Class, Inputs, Outputs, Queue, Side};

    /// What comes in.
    #[derive(Debug, Inputs)]
    enum Input {
        /// The ego's own, of any
        /// form.
        #[port(any_of(Boxes, FeatureMap), query, of(Ego))]
        Ego(Message),
        /// What the bank chose.
        #[port(latest, joined("frame"), optional)]
        BankChoice(Header, Selection),
    }

    /// What goes out.
    #[derive(Outputs)]
    enum Output {
        /// Boxes.
        Boxes(Header, Boxes),
        /// Anything else.
        #[port(any_of(FeatureMap, Selection))]
        Other(Message),
    }

    fn header() -> Header {
        Header::origin(&"run".into(), &"a".into(), Kind::Boxes, 3, 5, 6)
    }

    #[test]
    fn ports_are_as_their_variants_say() {
        let [ego, choice] = Input::PORTS else { panic!() };
        assert_eq!((ego.name, ego.about), ("ego", "The ego's own, of any form"));
        assert_eq!(ego.types, [PayloadType::Boxes, PayloadType::FeatureMap]);
        assert_eq!(
            (ego.class, ego.queue, ego.side),
            (Class::Query, Queue::All, Some(Side::Ego))
        );
        assert_eq!(
            (choice.name, choice.types),
            ("bank_choice", &[PayloadType::Selection][..])
        );
        assert_eq!(
            (choice.queue, choice.join, choice.required),
            (Queue::Latest, Some("frame"), false)
        );
        assert_eq!((Input::BANK_CHOICE, Output::OTHER), (PortId(1), PortId(1)));
    }

    #[test]
    fn a_message_becomes_the_variant_of_its_port_and_back() {
        let boxes = Boxes(Vec::<Box3>::new());
        let sent = Output::Boxes(header(), boxes.clone()).into_message();
        assert_eq!(sent, (Output::BOXES, Message::new(header(), boxes.clone())));
        let Input::Ego(message) = Input::read(Input::EGO, sent.1).unwrap() else {
            panic!()
        };
        let error = Input::read(Input::BANK_CHOICE, message.clone()).unwrap_err();
        assert!(matches!(error, PortError::Payload(_)), "{error}");
        let error = Input::read(PortId(2), message).unwrap_err();
        assert_eq!(error.to_string(), "a message on port number 2, this operator has 2");
        let selection = Selection {
            query: 3,
            entries: Vec::new(),
        };
        let read = Input::read(Input::BANK_CHOICE, Message::new(header(), selection)).unwrap();
        assert!(matches!(
            read,
            Input::BankChoice(Header { seq: 3, .. }, Selection { query: 3, .. })
        ));
        assert_eq!(
            Output::Other(Message::new(header(), boxes)).into_message().0,
            Output::OTHER
        );
    }
}
