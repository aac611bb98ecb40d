//! Agents and `StationId`.

use realo_schemas::Name;

/// What the name of an agent begins with that is known by its `StationId` alone.
const STATION: &str = "station-";

/// The agent that a `StationId` stands for where nothing else is known of it.
pub(crate) fn agent_of(station: u32) -> Name {
    format!("{STATION}{station}").into()
}

/// `station-4711` has the `StationId` 4711; that of any other name is its 32-bit FNV-1a hash, the same everywhere.
pub fn station_of(agent: &str) -> u32 {
    let reported = agent.strip_prefix(STATION).and_then(|number| number.parse().ok());
    // `station-007` and `station-+7` are names as any other.
    let reported = reported.filter(|station| *agent_of(*station) == *agent);
    reported.unwrap_or_else(|| hash_of(agent.as_bytes()))
}

/// The id of a track in 16 bits: itself where it fits, else its 32-bit FNV-1a hash, upper half xor lower half.
pub(crate) fn id_of(track: u64) -> u16 {
    u16::try_from(track).unwrap_or_else(|_| {
        let hash = hash_of(&track.to_be_bytes());
        (hash >> 16) as u16 ^ hash as u16
    })
}

/// FNV-1a of 32 bits.
fn hash_of(bytes: &[u8]) -> u32 {
    let step = |hash: u32, byte: &u8| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193);
    bytes.iter().fold(0x811c_9dc5, step)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_have_the_station_ids_that_the_documentation_says() {
        // The test vectors of the hash: "", "a", "foobar".
        assert_eq!(station_of(""), 0x811c_9dc5);
        assert_eq!(station_of("a"), 0xe40c_292c);
        assert_eq!(station_of("foobar"), 0xbf9c_f968);
        for station in [0, 4711, u32::MAX] {
            assert_eq!(station_of(&agent_of(station)), station);
        }
        assert_ne!(station_of("station-007"), 7);
        assert_ne!(station_of("station-+7"), 7);
        assert_ne!(station_of("station-4294967296"), 0);
    }
}
