//! Frames that Zenoh drops before anybody hears them: those of more bytes than a session takes. It counts them nowhere; one of
//! its traces says so, which is listened to here.

use std::fmt::Debug;
use std::sync::Once;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing::field::{Field, Visit};
use tracing::level_filters::LevelFilter;
use tracing::span::{Attributes, Id, Record};
use tracing::subscriber::{Interest, set_global_default};
use tracing::{Event, Metadata, Subscriber};

/// Where Zenoh puts the parts of a frame together.
const TARGET: &str = "zenoh_transport::unicast::universal::rx";
/// How its words begin where a frame becomes too large.
const WORDS: &str = "Defragmentation buffer full";

static DROPPED: AtomicU64 = AtomicU64::new(0);

/// Counts from now on, unless somebody else listens to this process's traces.
pub(crate) fn listen() {
    static ONCE: Once = Once::new();
    ONCE.call_once(|| drop(set_global_default(Listener)));
}

/// Frames that were too large so far, of all sessions of the process.
pub(crate) fn dropped() -> u64 {
    DROPPED.load(Ordering::Relaxed)
}

/// Hears events of [`TARGET`] and nothing else.
struct Listener;

impl Subscriber for Listener {
    fn register_callsite(&self, metadata: &'static Metadata<'static>) -> Interest {
        match self.enabled(metadata) {
            true => Interest::always(),
            false => Interest::never(),
        }
    }

    fn enabled(&self, metadata: &Metadata<'_>) -> bool {
        metadata.is_event() && metadata.target() == TARGET
    }

    fn max_level_hint(&self) -> Option<LevelFilter> {
        Some(LevelFilter::TRACE)
    }

    fn event(&self, event: &Event<'_>) {
        event.record(&mut Words);
    }

    fn new_span(&self, _: &Attributes<'_>) -> Id {
        Id::from_u64(1)
    }

    fn record(&self, _: &Id, _: &Record<'_>) {}

    fn record_follows_from(&self, _: &Id, _: &Id) {}

    fn enter(&self, _: &Id) {}

    fn exit(&self, _: &Id) {}
}

struct Words;

impl Visit for Words {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        if field.name() == "message" && format!("{value:?}").starts_with(WORDS) {
            DROPPED.fetch_add(1, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;
    use std::time::{Duration, Instant};

    use zenoh::Wait;
    use zenoh::qos::CongestionControl;

    use super::*;
    use crate::session::{Place, open};

    #[test]
    fn frames_that_zenoh_drops_are_counted() {
        let port = TcpListener::bind("127.0.0.1:0").and_then(|free| free.local_addr());
        let address = format!("tcp/127.0.0.1:{}", port.expect("a port is free").port());
        let place = |listen: &[&str], connect: &[&str]| {
            let endpoints = |texts: &[&str]| texts.iter().map(|text| text.parse().expect("an address")).collect();
            Place {
                listen: endpoints(listen),
                connect: endpoints(connect),
                ..Place::default()
            }
        };
        listen();
        let before = dropped();
        let hears = open(&place(&[&address], &[]), 0).expect("a session");
        let small = hears.declare_subscriber("realo/test").wait().expect("a subscriber");
        let sends = open(&place(&[], &[&address]), 0).expect("a session");
        let put = |bytes: usize| {
            let sent = sends.put("realo/test", vec![0_u8; bytes]);
            sent.congestion_control(CongestionControl::Block)
                .wait()
                .expect("it goes out");
        };
        // What comes shows that the way is open.
        let until = Instant::now() + Duration::from_secs(60);
        while small.try_recv().ok().flatten().is_none() {
            assert!(Instant::now() < until, "nothing comes");
            put(1);
            std::thread::sleep(Duration::from_millis(20));
        }
        put(64 << 20);
        while dropped() == before {
            assert!(Instant::now() < until, "it was not counted");
            std::thread::sleep(Duration::from_millis(20));
        }
        let received = std::iter::from_fn(|| small.try_recv().ok().flatten());
        assert!(received.map(|sample| sample.payload().len()).all(|bytes| bytes == 1));
    }
}
