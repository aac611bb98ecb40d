//! The map file: one head, the voxels, the frame's name, a checksum. Numbers are little endian.
//!
//! | bytes | content |
//! |---|---|
//! | 0–7 | `REALOMAP` |
//! | 8–11 | version, u32 |
//! | 12–15 | bytes of the frame's name, u32, at most 255 |
//! | 16–23 | number of voxels, u64 |
//! | 24–31 | side of a voxel, f64, m |
//! | 32–39 | thickness, f64, m |
//! | 40–63 | origin: x, y, z, f64, m |
//! | 64–87 | standard deviations of the poses: on the ground, up, m, of the heading, rad, f64 |
//! | 88–95 | sweeps that it was built from, u64 |
//! | 96–111 | stamps of the first and the last of them, i64, ns |
//! | 112–119 | cells left out, u64 |
//! | 120–127 | keyframes whose poses a pose graph found, u64; 0: poses were given |
//! | 128–135 | loops that were closed, u64 |
//! | 136–151 | what they were off before and after, root mean square, f64, m |
//! | 152–167 | the same of turns, f64, rad |
//! | 168– | voxels of 32 bytes each, their keys rising |
//! | … | the frame's name, UTF-8 |
//! | last 4 | CRC-32 of all before |

use std::fs::File;
use std::io::Write;
use std::path::Path;

use nalgebra::Point3;

use crate::cell::{cell_of, key_of};
use crate::error::{Flaw, MAX_PLACE_M, MapError};
use crate::map::{Closure, MapInfo, VoxelMap};
use crate::voxel::{BYTES, Record};

/// What a map file begins with.
pub const MAGIC: &[u8; 8] = b"REALOMAP";
/// Version of the layout.
const VERSION: u32 = 3;
const HEAD: usize = 168;
const CHECKSUM: usize = 4;
const MAX_NAME: usize = 255;

/// The bytes of a map.
#[derive(Debug)]
pub(crate) enum Bytes {
    /// Made here.
    Owned(Vec<u8>),
    /// A file's.
    Mapped(memmap2::Mmap),
}

impl Bytes {
    pub fn as_slice(&self) -> &[u8] {
        match self {
            Bytes::Owned(bytes) => bytes,
            Bytes::Mapped(bytes) => bytes,
        }
    }
}

/// The bytes of a map of these records; the frame's name is cut after 255 bytes.
fn encode(info: &MapInfo, records: &[[u8; BYTES]]) -> Vec<u8> {
    let name = &info.frame[..info.frame.floor_char_boundary(MAX_NAME)];
    let mut bytes = Vec::with_capacity(HEAD + records.len() * BYTES + name.len() + CHECKSUM);
    bytes.extend(MAGIC);
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend((name.len() as u32).to_le_bytes());
    bytes.extend((records.len() as u64).to_le_bytes());
    let numbers = [
        info.voxel_m,
        info.thickness_m,
        info.origin.x,
        info.origin.y,
        info.origin.z,
    ];
    let numbers = numbers.into_iter().chain(info.pose_sigmas);
    bytes.extend(numbers.flat_map(f64::to_le_bytes));
    bytes.extend(info.sweeps.to_le_bytes());
    bytes.extend(info.span.into_iter().flat_map(i64::to_le_bytes));
    bytes.extend(info.left_out.to_le_bytes());
    let closure = info.closure.unwrap_or_default();
    bytes.extend(
        [closure.keyframes, closure.loops]
            .into_iter()
            .flat_map(u64::to_le_bytes),
    );
    let residuals = closure.residuals_m.into_iter().chain(closure.residuals_rad);
    bytes.extend(residuals.flat_map(f64::to_le_bytes));
    bytes.extend(records.as_flattened());
    bytes.extend(name.as_bytes());
    bytes.extend(crc32fast::hash(&bytes).to_le_bytes());
    bytes
}

/// The map of these records, whose keys rise.
pub(crate) fn made(info: MapInfo, records: &[[u8; BYTES]]) -> VoxelMap {
    let bytes = encode(&info, records);
    VoxelMap::of(info, Bytes::Owned(bytes), HEAD..HEAD + records.len() * BYTES)
}

/// Reads numbers one after another.
struct Head<'a>(&'a [u8; HEAD], usize);

impl Head<'_> {
    fn take<const N: usize>(&mut self) -> [u8; N] {
        let at = self.1;
        self.1 += N;
        std::array::from_fn(|i| self.0[at + i])
    }

    /// A number within a range.
    fn number(&mut self, field: &'static str, expected: &'static str, range: [f64; 2]) -> Result<f64, Flaw> {
        let found = f64::from_le_bytes(self.take());
        match found >= range[0] && found <= range[1] {
            true => Ok(found),
            false => Err(Flaw::Field {
                field,
                expected,
                found: found.to_string(),
            }),
        }
    }
}

/// Checks all of a file; what it says of itself, and where its records are.
fn check(bytes: &[u8]) -> Result<(MapInfo, std::ops::Range<usize>), Flaw> {
    if !bytes.starts_with(MAGIC) {
        return Err(Flaw::Foreign);
    }
    let head = bytes.first_chunk::<HEAD>().ok_or(Flaw::Length {
        expected: (HEAD + CHECKSUM) as u128,
        found: bytes.len(),
    })?;
    let mut head = Head(head, MAGIC.len());
    let version = u32::from_le_bytes(head.take());
    if version != VERSION {
        return Err(Flaw::Version {
            expected: VERSION,
            found: version,
        });
    }
    let name = u32::from_le_bytes(head.take());
    let voxels = u64::from_le_bytes(head.take());
    let expected = (HEAD + CHECKSUM) as u128 + u128::from(name) + u128::from(voxels) * BYTES as u128;
    if expected != bytes.len() as u128 {
        return Err(Flaw::Length {
            expected,
            found: bytes.len(),
        });
    }
    let (body, checksum) = bytes.split_at(bytes.len() - CHECKSUM);
    let expected = u32::from_le_bytes(std::array::from_fn(|i| checksum[i]));
    let found = crc32fast::hash(body);
    if expected != found {
        return Err(Flaw::Checksum { expected, found });
    }
    let records = HEAD..body.len() - name as usize;
    let info = info(head, &body[records.end..])?;
    check_records(body[records.clone()].as_chunks().0)?;
    Ok((info, records))
}

/// What is behind the lengths in the head.
fn info(mut head: Head, name: &[u8]) -> Result<MapInfo, Flaw> {
    let field = |field, expected, found: String| Flaw::Field { field, expected, found };
    // Behind the name's length and the number of voxels.
    let frame = match str::from_utf8(name) {
        Ok(frame) if frame.len() <= MAX_NAME => frame.to_string(),
        _ => {
            return Err(field(
                "frame",
                "UTF-8 of at most 255 bytes",
                format!("{} bytes", name.len()),
            ));
        }
    };
    let voxel_m = head.number("voxel_m", "0.05 to 10", [0.05, 10.0])?;
    let thickness_m = head.number("thickness_m", "0.001 to 1", [1e-3, 1.0])?;
    let place = "a finite number within ±1e8";
    let mut axis = |name| head.number(name, place, [-MAX_PLACE_M, MAX_PLACE_M]);
    let origin = Point3::new(axis("origin.x")?, axis("origin.y")?, axis("origin.z")?);
    let mut sigma = |name| head.number(name, "0 to 1e6", [0.0, 1e6]);
    let pose_sigmas = [
        sigma("pose_sigmas, on the ground")?,
        sigma("pose_sigmas, up")?,
        sigma("pose_sigmas, heading")?,
    ];
    Ok(MapInfo {
        frame,
        voxel_m,
        thickness_m,
        origin,
        pose_sigmas,
        sweeps: u64::from_le_bytes(head.take()),
        span: [i64::from_le_bytes(head.take()), i64::from_le_bytes(head.take())],
        left_out: u64::from_le_bytes(head.take()),
        closure: closure(&mut head)?,
    })
}

/// How a pose graph found the poses; `None` where they were given.
fn closure(head: &mut Head) -> Result<Option<Closure>, Flaw> {
    let [keyframes, loops] = [(); 2].map(|()| u64::from_le_bytes(head.take()));
    let mut residual = |name| head.number(name, "0 to 1e6", [0.0, 1e6]);
    let closure = Closure {
        keyframes,
        loops,
        residuals_m: [residual("residuals_m, before")?, residual("residuals_m, after")?],
        residuals_rad: [residual("residuals_rad, before")?, residual("residuals_rad, after")?],
    };
    Ok((keyframes > 0).then_some(closure))
}

/// Refuses records out of order, and what no voxel has.
fn check_records(records: &[[u8; BYTES]]) -> Result<(), Flaw> {
    let mut last = 0;
    for record in records.iter().map(Record) {
        let key = record.key();
        let found = || format!("{:?} (key {key})", cell_of(key));
        if key <= last || key_of(cell_of(key)) != key {
            return Err(Flaw::Field {
                field: "cell",
                expected: "cells of rising keys within ±(2²⁰ − 2)",
                found: found(),
            });
        }
        if record.axis() > 2 || record.points() == 0 || !record.is_sound_normal() {
            return Err(Flaw::Field {
                field: "voxel",
                expected: "a point or more, an axis of 0 to 2, and a normal of length 1 along it",
                found: format!(
                    "{} points, axis {}, parts {:.2?} across it, in cell {}",
                    record.points(),
                    record.axis(),
                    record.sides(),
                    found()
                ),
            });
        }
        last = key;
    }
    Ok(())
}

impl VoxelMap {
    /// The map that bytes are.
    ///
    /// # Errors
    /// Bytes that are anything but a whole and sound map.
    pub fn from_bytes(bytes: Vec<u8>) -> Result<Self, Flaw> {
        let (info, records) = check(&bytes)?;
        Ok(VoxelMap::of(info, Bytes::Owned(bytes), records))
    }

    /// Opens a map file. It is mapped into memory and used in place: processes that use the same map share it.
    ///
    /// To replace a map that is in use, write another file and rename it, as [`VoxelMap::write`] does. A file that is cut while it is
    /// mapped ends the process (SIGBUS), as with every mapping.
    ///
    /// # Errors
    /// [`MapError::Read`] if the system does not let it be read; [`MapError::Unsound`] if it is anything but a whole and sound map.
    pub fn open(path: &Path) -> Result<Self, MapError> {
        let read = |reason| MapError::Read {
            path: path.into(),
            reason,
        };
        let unsound = |flaw| MapError::Unsound {
            path: path.into(),
            flaw,
        };
        let file = File::open(path).map_err(read)?;
        if file.metadata().map_err(read)?.is_dir() {
            let what = "it is a folder; expected a map that `realo map build` wrote";
            return Err(read(std::io::Error::new(std::io::ErrorKind::IsADirectory, what)));
        }
        if file.metadata().map_err(read)?.len() < (HEAD + CHECKSUM) as u64 {
            // Nothing to map, and too short for a map: read it for the reason.
            let bytes = std::fs::read(path).map_err(read)?;
            return VoxelMap::from_bytes(bytes).map_err(unsound);
        }
        #[allow(unsafe_code)]
        // SAFETY: another program may write to the file meanwhile. Its lengths are read once, here; of all that is read later any bytes
        // are finite numbers (`voxel.rs`), and no index is made of them.
        let bytes = Bytes::Mapped(unsafe { memmap2::Mmap::map(&file) }.map_err(read)?);
        let (info, records) = check(bytes.as_slice()).map_err(unsound)?;
        Ok(VoxelMap::of(info, bytes, records))
    }

    /// Writes the map, first beside `path` and then in its place.
    ///
    /// # Errors
    /// What the system says.
    pub fn write(&self, path: &Path) -> Result<(), MapError> {
        let mut beside = path.as_os_str().to_owned();
        beside.push(format!(".{}.partial", std::process::id()));
        let write = || {
            let mut file = File::create(&beside)?;
            file.write_all(self.as_bytes())?;
            file.sync_all()?;
            std::fs::rename(&beside, path)
        };
        write().map_err(|reason| {
            // It may not even be there.
            let _ = std::fs::remove_file(&beside);
            MapError::Write {
                path: path.into(),
                reason,
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use damage::{Draw, cases, most_held};

    use super::*;
    use crate::voxel::Moments;

    fn sound() -> Vec<u8> {
        let mut draw = Draw::new(3);
        let records = (0..5).map(|x| {
            let mut moments = Moments::default();
            for _ in 0..20 {
                moments.add([0; 3].map(|_| draw.below(1000) as f64 * 1e-3 - 0.5));
            }
            moments.encode(key_of([x - 2, 3 * x, -x]), 1.0, 0.05)
        });
        let info = MapInfo {
            frame: "map".into(),
            voxel_m: 1.0,
            thickness_m: 0.05,
            origin: Point3::new(4e5, -5e6, 12.0),
            pose_sigmas: [0.02, 0.03, 1e-3],
            sweeps: 30,
            span: [1, 3_000_000_000],
            left_out: 4,
            closure: Some(Closure {
                keyframes: 20,
                loops: 3,
                residuals_m: [1.5, 0.1],
                residuals_rad: [0.02, 1e-3],
            }),
        };
        encode(&info, &records.collect::<Vec<_>>())
    }

    /// The bytes with a checksum that fits them.
    fn signed(mut bytes: Vec<u8>) -> Vec<u8> {
        let body = bytes.len() - CHECKSUM;
        let checksum = crc32fast::hash(&bytes[..body]);
        bytes[body..].copy_from_slice(&checksum.to_le_bytes());
        bytes
    }

    #[test]
    fn a_map_survives_as_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("street.map");
        let map = VoxelMap::from_bytes(sound()).unwrap();
        assert_eq!(
            (map.len(), map.info().frame.as_str(), map.info().sweeps),
            (5, "map", 30)
        );
        map.write(&path).unwrap();
        let read = VoxelMap::open(&path).unwrap();
        assert!(read.as_bytes() == map.as_bytes() && read.info() == map.info());
        assert!(read.voxels().eq(map.voxels()));
        for voxel in map.voxels() {
            assert_eq!(read.voxel(voxel.cell), Some(voxel));
        }
        assert_eq!(read.voxel([9; 3]), None);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn every_changed_byte_and_every_cut_is_refused() {
        let sound = sound();
        for at in 0..sound.len() {
            for flip in [1, 0x80, 0xff] {
                let mut bytes = sound.clone();
                bytes[at] ^= flip;
                let flaw = VoxelMap::from_bytes(bytes).expect_err("a changed byte");
                let fits = match at {
                    0..8 => flaw == Flaw::Foreign,
                    8..12 => matches!(flaw, Flaw::Version { expected: VERSION, .. }),
                    12..24 => matches!(flaw, Flaw::Length { .. }),
                    _ => matches!(flaw, Flaw::Checksum { .. }),
                };
                assert!(fits, "byte {at}: {flaw}");
            }
            let cut = VoxelMap::from_bytes(sound[..at].to_vec()).expect_err("a cut");
            assert!(matches!(cut, Flaw::Foreign | Flaw::Length { .. }), "cut at {at}: {cut}");
        }
        let longer = [&sound[..], &[0]].concat();
        assert!(matches!(VoxelMap::from_bytes(longer), Err(Flaw::Length { .. })));
    }

    #[test]
    fn numbers_that_no_map_has_are_refused_under_a_fitting_checksum() {
        let of = |at: usize, new: &[u8]| {
            let mut bytes = sound();
            bytes[at..at + new.len()].copy_from_slice(new);
            VoxelMap::from_bytes(signed(bytes)).map_or_else(|flaw| flaw.to_string(), |_| "sound".into())
        };
        let first = HEAD;
        for (at, new, expected) in [
            (
                24,
                &f64::NAN.to_le_bytes()[..],
                "`voxel_m`: expected 0.05 to 10, found NaN",
            ),
            (24, &0.0f64.to_le_bytes(), "`voxel_m`"),
            (32, &(-1.0f64).to_le_bytes(), "`thickness_m`"),
            (48, &f64::INFINITY.to_le_bytes(), "`origin.y`"),
            (first, &[0xff; 8], "`cell`"),
            (first, &[0; 8], "`cell`"),
            (first + 14, &[1, 0x60], "axis 3"),
            (first + 14, &[0, 0], "0 points"),
            (first + 16, &[0xff, 0x7f, 0xff, 0x7f], "parts [1.00, 1.00] across it"),
            (first + BYTES * 5, &[0xff], "`frame`: expected UTF-8"),
            (64, &f64::NAN.to_le_bytes(), "`pose_sigmas, on the ground`"),
            (88, &[7], "sound"),
            (136, &(-1.0f64).to_le_bytes(), "`residuals_m, before`"),
            (160, &f64::NAN.to_le_bytes(), "`residuals_rad, after`"),
        ] {
            let found = of(at, new);
            assert!(found.contains(expected), "byte {at}: {found}");
        }
    }

    #[test]
    fn nothing_that_a_file_says_takes_memory_or_panics() {
        let sound = sound();
        let mut draw = Draw::new(4);
        for case in 0..cases(3000) {
            let mut bytes = sound.clone();
            draw.damage(&mut bytes);
            if bytes.len() > HEAD + CHECKSUM {
                bytes = signed(bytes);
            }
            let room = 64 * bytes.len() as u64 + 10_000;
            let held = most_held(|| {
                if let Ok(map) = VoxelMap::from_bytes(bytes) {
                    assert!(map.voxels().all(|voxel| voxel.normal.norm() < 1.1));
                }
            });
            assert!(held < room, "case {case}: {held} bytes");
        }
    }

    #[test]
    fn foreign_files_are_refused_by_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        assert!(matches!(VoxelMap::open(&path), Err(MapError::Read { .. })));
        for content in ["", "notes", &"# notes\n".repeat(100)] {
            std::fs::write(&path, content).unwrap();
            let error = VoxelMap::open(&path).unwrap_err().to_string();
            assert!(
                error.contains("notes.txt") && error.contains("realo map build"),
                "{error}"
            );
        }
        let map = VoxelMap::from_bytes(sound()).unwrap();
        let error = map
            .write(&folder.path().join("none/street.map"))
            .unwrap_err()
            .to_string();
        assert!(error.contains("cannot be written"), "{error}");
    }
}
