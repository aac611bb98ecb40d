//! Tables of an SQLite file, read only: as much of the format (<https://sqlite.org/fileformat2.html>) as bags of ROS 2 need.
//!
//! Own code in place of `rusqlite`, whose bundled C takes longer to compile than all importers, and which cannot be bound in memory.

mod record;

use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use self::record::{Value, columns_of, values, varint};
use crate::BagError;

/// How an SQLite file begins.
pub(crate) const MAGIC: &[u8] = b"SQLite format 3\0";
/// Bytes before the first page's own head.
const FILE_HEAD: usize = 100;
/// Types of pages of a table.
const INNER: u8 = 0x05;
const LEAF: u8 = 0x0d;
/// A table of 2³² pages is no deeper.
const DEEPEST: usize = 32;

pub(crate) use self::record::Value as Column;

/// An open SQLite file.
pub(crate) struct Database {
    path: PathBuf,
    file: File,
    page_size: usize,
    /// Bytes of a page that tables use.
    usable: usize,
    pages: u32,
}

/// A table of a database.
pub(crate) struct Table {
    root: u32,
    columns: Vec<String>,
}

/// Where a row is.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Place {
    page: u32,
    cell: u16,
}

/// The head of a row, with the payload that is on its own page.
struct Cell<'a> {
    rowid: i64,
    length: usize,
    local: &'a [u8],
    /// The first page of the rest.
    overflow: Option<u32>,
}

impl Database {
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let mut file = File::open(path).map_err(BagError::io(path))?;
        let size = file.metadata().map_err(BagError::io(path))?.len();
        let mut head = [0; FILE_HEAD];
        let wrong = |reason: &str| {
            BagError::content(
                path,
                format!("expected an SQLite database, found {reason}; fetch it anew"),
            )
        };
        if size < FILE_HEAD as u64 {
            return Err(wrong("less than its head"));
        }
        file.read_exact(&mut head).map_err(BagError::io(path))?;
        let page_size = match u16::from_be_bytes([head[16], head[17]]) {
            1 => 1 << 16,
            size => usize::from(size),
        };
        let usable = page_size.saturating_sub(head[20].into());
        if !head.starts_with(MAGIC) || !page_size.is_power_of_two() || page_size < 512 || usable < 480 {
            return Err(wrong("another head"));
        }
        Ok(Database {
            path: path.into(),
            file,
            page_size,
            usable,
            pages: u32::try_from(size / page_size as u64).unwrap_or(u32::MAX),
        })
    }

    /// Why the file lacks pages, if it does.
    pub fn cut(&mut self) -> Result<Option<String>, BagError> {
        let mut count = [0; 4];
        self.file.seek(SeekFrom::Start(28)).map_err(BagError::io(&self.path))?;
        self.file.read_exact(&mut count).map_err(BagError::io(&self.path))?;
        let expected = u32::from_be_bytes(count);
        Ok((expected > self.pages).then(|| format!("it is cut: it has {} of {expected} pages", self.pages)))
    }

    /// A table by its name.
    pub fn table(&mut self, name: &str) -> Result<Option<Table>, BagError> {
        // sqlite_schema: type, name, tbl_name, rootpage, sql.
        let schema = Table {
            root: 1,
            columns: ["type", "name", "tbl_name", "rootpage", "sql"].map(String::from).into(),
        };
        let mut found = None;
        let mut places = Vec::new();
        self.scan(&schema, &mut |place, _| places.push(place))?;
        for place in places {
            let row = self.read(place)?;
            if let [
                Value::Text(kind),
                Value::Text(table),
                _,
                Value::Integer(root),
                Value::Text(sql),
            ] = &row[..]
                && kind == "table"
                && table == name
            {
                let root = u32::try_from(*root).unwrap_or(0);
                let columns = columns_of(sql);
                found = Some(Table { root, columns });
            }
        }
        Ok(found)
    }

    fn damaged(&self, reason: impl std::fmt::Display) -> BagError {
        BagError::content(
            &self.path,
            format!("a damaged database: {reason}; fetch it anew, or try `sqlite3 FILE .recover`"),
        )
    }

    fn page(&mut self, number: u32) -> Result<Vec<u8>, BagError> {
        if number == 0 || number > self.pages {
            return Err(self.damaged(format!("page {number} of {} is asked for", self.pages)));
        }
        let mut page = vec![0; self.page_size];
        let at = u64::from(number - 1) * self.page_size as u64;
        self.file.seek(SeekFrom::Start(at)).map_err(BagError::io(&self.path))?;
        self.file.read_exact(&mut page).map_err(BagError::io(&self.path))?;
        Ok(page)
    }

    /// Calls `each` with the place and the values of every row that are on the row's own page; the rest is [`Value::Elsewhere`].
    pub fn scan(&mut self, table: &Table, each: &mut dyn FnMut(Place, Vec<Value>)) -> Result<(), BagError> {
        let mut visited = 0;
        self.walk(table.root, 0, &mut visited, each)
    }

    fn walk(
        &mut self,
        number: u32,
        depth: usize,
        visited: &mut u32,
        each: &mut dyn FnMut(Place, Vec<Value>),
    ) -> Result<(), BagError> {
        *visited += 1;
        if depth > DEEPEST || *visited > self.pages {
            return Err(self.damaged("its pages lead in a circle"));
        }
        let page = self.page(number)?;
        let head = if number == 1 { FILE_HEAD } else { 0 };
        let kind = page[head];
        let cells = usize::from(u16::from_be_bytes([page[head + 3], page[head + 4]]));
        let pointers = head + if kind == INNER { 12 } else { 8 };
        if pointers + 2 * cells > page.len() {
            return Err(self.damaged(format!("page {number} says that it has {cells} cells")));
        }
        let child = |at: usize| {
            let bytes = page.get(at..at + 4)?;
            Some(u32::from_be_bytes(std::array::from_fn(|i| bytes[i])))
        };
        match kind {
            INNER => {
                for cell in 0..cells {
                    let at = u16::from_be_bytes([page[pointers + 2 * cell], page[pointers + 2 * cell + 1]]);
                    let next = child(at.into()).ok_or_else(|| self.damaged("a cell beyond its page"))?;
                    self.walk(next, depth + 1, visited, each)?;
                }
                let last = child(head + 8).ok_or_else(|| self.damaged("a page without its last child"))?;
                self.walk(last, depth + 1, visited, each)
            }
            LEAF => {
                for cell in 0..cells as u16 {
                    let found = self.cell(&page, head, cell).map_err(|reason| self.damaged(reason))?;
                    let mut row = values(found.local, found.length).map_err(|reason| self.damaged(reason))?;
                    if row.first() == Some(&Value::Null) {
                        row[0] = Value::Integer(found.rowid);
                    }
                    each(Place { page: number, cell }, row);
                }
                Ok(())
            }
            other => Err(self.damaged(format!("page {number} is of type {other:#04x}, expected a table"))),
        }
    }

    fn cell<'a>(&self, page: &'a [u8], head: usize, cell: u16) -> Result<Cell<'a>, String> {
        let wrong = || format!("cell {cell} goes beyond its page");
        let pointer = head + 8 + 2 * usize::from(cell);
        let at = page.get(pointer..pointer + 2).ok_or_else(wrong)?;
        let mut rest = page
            .get(usize::from(u16::from_be_bytes([at[0], at[1]]))..)
            .ok_or_else(wrong)?;
        let length = varint(&mut rest).ok_or_else(wrong)?;
        let rowid = varint(&mut rest).ok_or_else(wrong)?;
        let length = usize::try_from(length).map_err(|_| wrong())?;
        // No row is longer than the file.
        if length as u64 > u64::from(self.pages) * self.page_size as u64 {
            return Err(format!("a row of {length} bytes in a file of {} pages", self.pages));
        }
        let most = self.usable - 35;
        let local = if length <= most {
            length
        } else {
            let least = (self.usable - 12) * 32 / 255 - 23;
            let kept = least + (length - least) % (self.usable - 4);
            if kept <= most { kept } else { least }
        };
        let (local, rest) = rest.split_at_checked(local).ok_or_else(wrong)?;
        let overflow = match local.len() < length {
            true => {
                let page = rest.first_chunk::<4>().ok_or_else(wrong)?;
                Some(u32::from_be_bytes(*page))
            }
            false => None,
        };
        Ok(Cell {
            rowid,
            length,
            local,
            overflow,
        })
    }

    /// All values of a row.
    pub fn read(&mut self, place: Place) -> Result<Vec<Value>, BagError> {
        let page = self.page(place.page)?;
        let head = if place.page == 1 { FILE_HEAD } else { 0 };
        let cell = self
            .cell(&page, head, place.cell)
            .map_err(|reason| self.damaged(reason))?;
        let (rowid, length, mut next) = (cell.rowid, cell.length, cell.overflow);
        let mut payload = cell.local.to_vec();
        // Each page adds bytes, and the row is no longer than the file: this ends.
        while payload.len() < length {
            let number = next.ok_or_else(|| self.damaged("a row without its rest"))?;
            let page = self.page(number)?;
            next = page.first_chunk::<4>().map(|bytes| u32::from_be_bytes(*bytes));
            let taken = (length - payload.len()).min(self.usable - 4);
            payload.extend(&page[4..4 + taken]);
        }
        let mut row = values(&payload, length).map_err(|reason| self.damaged(reason))?;
        if row.first() == Some(&Value::Null) {
            row[0] = Value::Integer(rowid);
        }
        Ok(row)
    }
}

impl Table {
    /// Where a column is.
    pub fn column(&self, name: &str) -> Option<usize> {
        self.columns.iter().position(|column| column == name)
    }
}
