//! Bags, written by hand: ROS 1, and the files of ROS 2.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;

use realo_schemas::Nanos;

use super::wire::{Recorded, Wire, bytes};

/// How chunks of ROS 1 are compressed.
pub const PACKINGS: [&str; 3] = ["none", "lz4", "bz2"];
/// Messages of a chunk.
const PER_CHUNK: usize = 7;

fn field(name: &str, value: &[u8]) -> Vec<u8> {
    let length = (name.len() + 1 + value.len()) as u32;
    [&length.to_le_bytes()[..], name.as_bytes(), b"=", value].concat()
}

fn record(fields: &[Vec<u8>], data: &[u8]) -> Vec<u8> {
    let head = fields.concat();
    let lengths = [head.len(), data.len()].map(|length| (length as u32).to_le_bytes());
    [&lengths[0][..], &head, &lengths[1], data].concat()
}

fn time(nanos: Nanos) -> [u8; 8] {
    let parts = [nanos / 1_000_000_000, nanos % 1_000_000_000].map(|part| (part as u32).to_le_bytes());
    std::array::from_fn(|i| parts[i / 4][i % 4])
}

fn packed(packing: &str, data: &[u8]) -> Vec<u8> {
    match packing {
        "lz4" => {
            let mut encoder = lz4::EncoderBuilder::new().build(Vec::new()).unwrap();
            encoder.write_all(data).unwrap();
            encoder.finish().0
        }
        "bz2" => {
            let mut encoder = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
            encoder.write_all(data).unwrap();
            encoder.finish().unwrap()
        }
        _ => data.to_vec(),
    }
}

/// A bag of ROS 1. Messages are in the order in which they are given.
pub fn ros1(path: &Path, messages: &[Recorded], packing: &str) {
    let mut known: BTreeMap<&str, u32> = BTreeMap::new();
    let mut connections = Vec::new();
    let mut file = b"#ROSBAG V2.0\n".to_vec();
    let head = |position: u64, connections: u32, chunks: u32| {
        let fields = [
            field("op", &[3]),
            field("index_pos", &position.to_le_bytes()),
            field("conn_count", &connections.to_le_bytes()),
            field("chunk_count", &chunks.to_le_bytes()),
        ];
        let room = 4096 - 8 - fields.concat().len();
        record(&fields, &vec![b' '; room])
    };
    let begins = file.len();
    file.extend(head(0, 0, 0));
    let mut chunks = 0;
    for messages in messages.chunks(PER_CHUNK) {
        let mut chunk = Vec::new();
        let mut index: BTreeMap<u32, Vec<u8>> = BTreeMap::new();
        for message in messages {
            let next = known.len() as u32;
            let id = *known.entry(message.topic).or_insert(next);
            if id == next {
                let data = [
                    field("topic", message.topic.as_bytes()),
                    field("type", message.kind.as_bytes()),
                ]
                .concat();
                let connection = record(
                    &[
                        field("op", &[7]),
                        field("conn", &id.to_le_bytes()),
                        field("topic", message.topic.as_bytes()),
                    ],
                    &data,
                );
                chunk.extend(&connection);
                connections.extend(connection);
            }
            let entry = [&time(message.log_time)[..], &(chunk.len() as u32).to_le_bytes()].concat();
            index.entry(id).or_default().extend(entry);
            let fields = [
                field("op", &[2]),
                field("conn", &id.to_le_bytes()),
                field("time", &time(message.log_time)),
            ];
            chunk.extend(record(&fields, &bytes(Wire::Ros1, &message.content)));
        }
        let fields = [
            field("op", &[5]),
            field("compression", packing.as_bytes()),
            field("size", &(chunk.len() as u32).to_le_bytes()),
        ];
        file.extend(record(&fields, &packed(packing, &chunk)));
        for (id, entries) in index {
            let count = (entries.len() / 12) as u32;
            let fields = [
                field("op", &[4]),
                field("ver", &1u32.to_le_bytes()),
                field("conn", &id.to_le_bytes()),
                field("count", &count.to_le_bytes()),
            ];
            file.extend(record(&fields, &entries));
        }
        chunks += 1;
    }
    let position = file.len() as u64;
    file.extend(connections);
    let head = head(position, known.len() as u32, chunks);
    file[begins..begins + head.len()].copy_from_slice(&head);
    fs::write(path, file).unwrap();
}

/// An MCAP file of another maker: no index, no chunks, as little as the format needs.
pub fn mcap(path: &Path, messages: &[Recorded], wire: Wire) {
    fn text(text: &str) -> Vec<u8> {
        [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat()
    }
    fn put(file: &mut Vec<u8>, opcode: u8, parts: &[&[u8]]) {
        let body = parts.concat();
        file.push(opcode);
        file.extend((body.len() as u64).to_le_bytes());
        file.extend(body);
    }
    const MAGIC: &[u8] = b"\x89MCAP0\r\n";
    let mut file = MAGIC.to_vec();
    put(&mut file, 1, &[&text("ros2"), &text("a test")]);
    let mut known: BTreeMap<&str, u16> = BTreeMap::new();
    for (sequence, message) in messages.iter().enumerate() {
        let next = known.len() as u16 + 1;
        let id = *known.entry(message.topic).or_insert(next);
        let number = id.to_le_bytes();
        if id == next {
            let kind = message.kind.replace('/', "/msg/");
            put(&mut file, 3, &[&number, &text(&kind), &text("ros2msg"), &text("")]);
            let encoding = if wire == Wire::Ros1 { "ros1" } else { "cdr" };
            put(
                &mut file,
                4,
                &[&number, &number, &text(message.topic), &text(encoding), &text("")],
            );
        }
        let time = (message.log_time as u64).to_le_bytes();
        let sequence = (sequence as u32).to_le_bytes();
        put(
            &mut file,
            5,
            &[&number, &sequence, &time, &time, &bytes(wire, &message.content)],
        );
    }
    put(&mut file, 15, &[&[0; 4]]);
    put(&mut file, 2, &[&[0; 20]]);
    file.extend(MAGIC);
    fs::write(path, file).unwrap();
}

const PAGE: usize = 1024;

fn varint(value: u64) -> Vec<u8> {
    let mut bytes = vec![(value & 0x7f) as u8];
    let mut rest = value >> 7;
    while rest > 0 {
        bytes.insert(0, (rest & 0x7f) as u8 | 0x80);
        rest >>= 7;
    }
    bytes
}

enum Cell<'a> {
    Null,
    Integer(i64),
    Text(&'a str),
    Blob(&'a [u8]),
}

fn row(cells: &[Cell]) -> Vec<u8> {
    let (mut types, mut values) = (Vec::new(), Vec::new());
    for cell in cells {
        match cell {
            Cell::Null => types.extend(varint(0)),
            Cell::Integer(value) => {
                types.extend(varint(6));
                values.extend(value.to_be_bytes());
            }
            Cell::Text(text) => {
                types.extend(varint(13 + 2 * text.len() as u64));
                values.extend(text.as_bytes());
            }
            Cell::Blob(blob) => {
                types.extend(varint(12 + 2 * blob.len() as u64));
                values.extend(*blob);
            }
        }
    }
    let head = varint(types.len() as u64 + 1);
    [head, types, values].concat()
}

/// Pages of an SQLite file.
struct Pages(Vec<Vec<u8>>);

impl Pages {
    fn add(&mut self, page: Vec<u8>) -> u32 {
        assert!(page.len() <= PAGE);
        self.0.push(page);
        self.0.last_mut().unwrap().resize(PAGE, 0);
        self.0.len() as u32
    }

    /// A row as a cell of a leaf; what does not fit goes to pages of its own.
    fn cell(&mut self, rowid: u64, row: &[u8]) -> Vec<u8> {
        let (most, least) = (PAGE - 35, (PAGE - 12) * 32 / 255 - 23);
        let kept = least + row.len().saturating_sub(least) % (PAGE - 4);
        let local = match row.len() {
            length if length <= most => length,
            _ if kept <= most => kept,
            _ => least,
        };
        let mut next = 0u32;
        for rest in row[local..].chunks(PAGE - 4).rev() {
            next = self.add([&next.to_be_bytes()[..], rest].concat());
        }
        let mut cell = [varint(row.len() as u64), varint(rowid), row[..local].to_vec()].concat();
        if local < row.len() {
            cell.extend(next.to_be_bytes());
        }
        cell
    }

    fn page(kind: u8, at: usize, last: Option<u32>, cells: &[Vec<u8>]) -> Vec<u8> {
        let mut page = vec![0; PAGE];
        page[at] = kind;
        page[at + 3..at + 5].copy_from_slice(&(cells.len() as u16).to_be_bytes());
        let mut pointer = at + 8;
        if let Some(last) = last {
            page[at + 8..at + 12].copy_from_slice(&last.to_be_bytes());
            pointer += 4;
        }
        let mut end = PAGE;
        for cell in cells {
            end -= cell.len();
            page[end..end + cell.len()].copy_from_slice(cell);
            page[pointer..pointer + 2].copy_from_slice(&(end as u16).to_be_bytes());
            pointer += 2;
        }
        assert!(pointer <= end, "a page of {} cells is too full", cells.len());
        page
    }

    /// A table; gives its root.
    fn table(&mut self, rows: &[Vec<u8>]) -> u32 {
        let cells: Vec<Vec<u8>> = rows
            .iter()
            .enumerate()
            .map(|(k, row)| self.cell(k as u64 + 1, row))
            .collect();
        let (mut leaves, mut leaf, mut size) = (Vec::new(), Vec::new(), 8);
        for (k, cell) in cells.iter().enumerate() {
            if size + cell.len() + 2 > PAGE {
                leaves.push((self.add(Self::page(0x0d, 0, None, &leaf)), k as u64));
                (leaf, size) = (Vec::new(), 8);
            }
            size += cell.len() + 2;
            leaf.push(cell.clone());
        }
        let last = self.add(Self::page(0x0d, 0, None, &leaf));
        if leaves.is_empty() {
            return last;
        }
        let inner = |(page, key): &(u32, u64)| [page.to_be_bytes().to_vec(), varint(*key)].concat();
        let inner: Vec<Vec<u8>> = leaves.iter().map(inner).collect();
        self.add(Self::page(0x05, 0, Some(last), &inner))
    }
}

/// An SQLite file of ROS 2; `packed`: each message by itself.
pub fn db3(path: &Path, messages: &[Recorded], wire: Wire, packed: bool) {
    let mut pages = Pages(vec![Vec::new()]);
    let mut known: BTreeMap<&str, (i64, &str)> = BTreeMap::new();
    let mut rows = Vec::new();
    for message in messages {
        let next = known.len() as i64 + 1;
        let (id, _) = *known.entry(message.topic).or_insert((next, message.kind));
        let mut data = bytes(wire, &message.content);
        if packed {
            data = zstd::bulk::compress(&data, 1).unwrap();
        }
        rows.push(row(&[
            Cell::Null,
            Cell::Integer(id),
            Cell::Integer(message.log_time),
            Cell::Blob(&data),
        ]));
    }
    let topics: Vec<Vec<u8>> = known
        .iter()
        .map(|(topic, (id, kind))| {
            let kind = kind.replace('/', "/msg/");
            row(&[
                Cell::Integer(*id),
                Cell::Text(topic),
                Cell::Text(&kind),
                Cell::Text("cdr"),
            ])
        })
        .collect();
    let tables = [
        (
            "topics",
            "CREATE TABLE topics(id INTEGER PRIMARY KEY,name TEXT NOT NULL,type TEXT NOT NULL,serialization_format TEXT NOT NULL)",
            pages.table(&topics),
        ),
        (
            "messages",
            "CREATE TABLE messages(id INTEGER PRIMARY KEY,topic_id INTEGER NOT NULL,timestamp INTEGER NOT NULL,data BLOB NOT NULL)",
            pages.table(&rows),
        ),
    ];
    let schema: Vec<Vec<u8>> = tables
        .iter()
        .enumerate()
        .map(|(k, (name, sql, root))| {
            let row = row(&[
                Cell::Text("table"),
                Cell::Text(name),
                Cell::Text(name),
                Cell::Integer((*root).into()),
                Cell::Text(sql),
            ]);
            pages.cell(k as u64 + 1, &row)
        })
        .collect();
    let mut first = Pages::page(0x0d, 100, None, &schema);
    first[..16].copy_from_slice(b"SQLite format 3\0");
    first[16..18].copy_from_slice(&(PAGE as u16).to_be_bytes());
    let count = pages.0.len() as u32;
    first[28..32].copy_from_slice(&count.to_be_bytes());
    pages.0[0] = first;
    fs::write(path, pages.0.concat()).unwrap();
}

/// Compresses a file as a whole, and removes it.
pub fn zstd_file(path: &Path) {
    let mut name = path.as_os_str().to_os_string();
    name.push(".zstd");
    let packed = zstd::encode_all(File::open(path).unwrap(), 1).unwrap();
    fs::write(name, packed).unwrap();
    fs::remove_file(path).unwrap();
}

/// The metadata of a folder with these parts.
pub fn metadata(dir: &Path, parts: &[&str], compression: [&str; 2], messages: usize) {
    let [format, mode] = compression;
    let parts: String = parts.iter().map(|part| format!("    - {part}\n")).collect();
    let text = format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  relative_file_paths:\n{parts}  duration:\n    \
         nanoseconds: 1\n  starting_time:\n    nanoseconds_since_epoch: 1\n  message_count: {messages}\n  \
         topics_with_message_count: []\n  compression_format: \"{format}\"\n  compression_mode: \"{mode}\"\n  \
         custom: !!python/object/apply:os.system ['touch /tmp/never']\n"
    );
    fs::write(dir.join("metadata.yaml"), text).unwrap();
}
