//! Bags of ROS 2 in SQLite.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use realo_schemas::Nanos;

use crate::source::{believed, plain_kind};
use crate::sqlite::{Column, Database, Place, Table};
use crate::{Bag, BagError, Connection, Encoding, Message, Messages};

/// Names of topics, types and serialisations are no longer, bytes.
const LONGEST_NAME: usize = 4096;

/// An open SQLite file of a bag.
pub(crate) struct Db3 {
    path: PathBuf,
    connections: Vec<Connection>,
    /// Time, connection and place of all messages, by time.
    rows: Arc<Vec<(Nanos, usize, Place)>>,
    data: usize,
    notes: Vec<String>,
}

impl Db3 {
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let mut database = Database::open(path)?;
        let mut notes: Vec<String> = database.cut()?.into_iter().collect();
        let journal = PathBuf::from(format!("{}-wal", path.display()));
        if journal.metadata().is_ok_and(|there| there.len() > 0) {
            notes.push(format!(
                "messages in `{}` are not read: merge it with `sqlite3 {} 'PRAGMA wal_checkpoint'`",
                journal.display(),
                path.display()
            ));
        }
        let topics = need(
            path,
            &mut database,
            "topics",
            &["id", "name", "type", "serialization_format"],
        )?;
        let messages = need(path, &mut database, "messages", &["topic_id", "timestamp", "data"])?;
        let (mut connections, mut known) = (Vec::new(), BTreeMap::new());
        let mut rows = Vec::new();
        database.scan(&topics.table, &mut |place, _| rows.push(place))?;
        for place in rows {
            let row = database.read(place)?;
            let text = |column: usize| match row.get(topics.columns[column]) {
                Some(Column::Text(text)) if text.len() > LONGEST_NAME => Err(BagError::content(
                    path,
                    format!(
                        "expected names of at most {LONGEST_NAME} bytes in `topics`, found one of {}; fetch it anew",
                        text.len()
                    ),
                )),
                Some(Column::Text(text)) => Ok(text.clone()),
                _ => Ok(String::new()),
            };
            if let Some(Column::Integer(id)) = row.get(topics.columns[0]) {
                if known.insert(*id, connections.len()).is_some() {
                    let reason =
                        format!("expected topics of different `id`, found {id} twice in `topics`; fetch it anew");
                    return Err(BagError::content(path, reason));
                }
                connections.push(Connection {
                    topic: text(1)?,
                    kind: plain_kind(&text(2)?),
                    encoding: Encoding::named(&text(3)?),
                    messages: 0,
                });
            }
        }
        let mut rows = Vec::new();
        let [topic, timestamp, data] = [0, 1, 2].map(|column| messages.columns[column]);
        let scanned = database.scan(&messages.table, &mut |place, row| {
            if let (Some(Column::Integer(topic)), Some(Column::Integer(time))) = (row.get(topic), row.get(timestamp))
                && let Some(connection) = known.get(topic)
            {
                connections[*connection].messages += 1;
                rows.push((believed(*time), *connection, place));
            }
        });
        match scanned {
            // What is whole of a cut file is read.
            Err(error) if !notes.is_empty() && !rows.is_empty() => notes.push(error.to_string()),
            scanned => scanned?,
        }
        rows.sort_by_key(|(time, ..)| *time);
        Ok(Db3 {
            path: path.into(),
            connections,
            rows: Arc::new(rows),
            data,
            notes,
        })
    }
}

struct Needed {
    table: Table,
    columns: Vec<usize>,
}

fn need(path: &Path, database: &mut Database, name: &str, columns: &[&str]) -> Result<Needed, BagError> {
    let not = |what: String| {
        BagError::content(
            path,
            format!("expected a bag of ROS 2, found a database without the {what}; give the bag's own file"),
        )
    };
    let table = database.table(name)?.ok_or_else(|| not(format!("table `{name}`")))?;
    let column = |column: &&str| {
        table
            .column(column)
            .ok_or_else(|| not(format!("column `{column}` in `{name}`")))
    };
    let columns = columns.iter().map(column).collect::<Result<_, _>>()?;
    Ok(Needed { table, columns })
}

impl Bag for Db3 {
    fn path(&self) -> &Path {
        &self.path
    }

    fn format(&self) -> &'static str {
        "bag of ROS 2 in SQLite"
    }

    fn connections(&self) -> &[Connection] {
        &self.connections
    }

    fn span(&self) -> Option<[Nanos; 2]> {
        Some([self.rows.first()?.0, self.rows.last()?.0])
    }

    fn notes(&self) -> &[String] {
        &self.notes
    }

    fn messages(&self, wanted: &BTreeSet<usize>) -> Result<Box<dyn Messages + '_>, BagError> {
        Ok(Box::new(InOrder {
            path: self.path.clone(),
            database: Database::open(&self.path)?,
            rows: self.rows.clone(),
            data: self.data,
            next: 0,
            wanted: wanted.clone(),
        }))
    }
}

struct InOrder {
    path: PathBuf,
    database: Database,
    rows: Arc<Vec<(Nanos, usize, Place)>>,
    data: usize,
    next: usize,
    wanted: BTreeSet<usize>,
}

impl Messages for InOrder {
    fn next(&mut self) -> Result<Option<Message>, BagError> {
        while let Some((time, connection, place)) = self.rows.get(self.next).copied() {
            self.next += 1;
            if !self.wanted.contains(&connection) {
                continue;
            }
            let mut row = self.database.read(place)?;
            return match row.get_mut(self.data).map(std::mem::take) {
                Some(Column::Blob(data)) => Ok(Some(Message::owned(connection, time, data))),
                _ => Err(BagError::content(
                    &self.path,
                    format!("a message at {time} ns: expected bytes in the column `data`, found another value"),
                )),
            };
        }
        Ok(None)
    }
}
