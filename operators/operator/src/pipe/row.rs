//! One row of Arrow as bytes, and the columns that the protocol's frames need.

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use arrow_array::{
    Array, ArrayRef, Int64Array, ListArray, RecordBatch, StringArray, StructArray, UInt32Array, UInt64Array,
};
use arrow_buffer::{Buffer, OffsetBuffer};
use arrow_ipc::reader::StreamDecoder;
use arrow_ipc::writer::StreamEncoder;
use arrow_schema::{ArrowError, Field, Fields};

/// A row under construction.
#[derive(Default)]
pub(super) struct Row {
    fields: Vec<Field>,
    columns: Vec<ArrayRef>,
}

impl Row {
    pub fn put(mut self, name: &str, column: impl Array + 'static) -> Self {
        self.fields.push(Field::new(name, column.data_type().clone(), true));
        self.columns.push(Arc::new(column));
        self
    }

    pub fn text(self, name: &str, text: &str) -> Self {
        self.put(name, StringArray::from(vec![text]))
    }

    pub fn list(self, name: &str, values: impl Array + 'static) -> Self {
        let field = Arc::new(Field::new("item", values.data_type().clone(), true));
        let offsets = OffsetBuffer::from_lengths([values.len()]);
        self.put(name, ListArray::new(field, offsets, Arc::new(values), None))
    }

    pub fn texts<'a>(self, name: &str, texts: impl Iterator<Item = &'a str>) -> Self {
        self.list(name, StringArray::from_iter_values(texts))
    }

    /// The row as an Arrow IPC stream, in parts that share the columns' memory.
    ///
    /// # Errors
    /// What Arrow cannot write.
    pub fn into_parts(self) -> Result<Vec<Buffer>, String> {
        let batch = RecordBatch::from(StructArray::new(Fields::from(self.fields), self.columns, None));
        let write = || {
            let mut encoder = StreamEncoder::try_new(&batch.schema())?;
            let mut parts = encoder.encode(&batch)?;
            parts.extend(encoder.finish()?);
            Ok(parts)
        };
        write().map_err(|error: ArrowError| format!("Arrow: {error}"))
    }
}

thread_local! {
    static READING: Cell<bool> = const { Cell::new(false) };
}

/// Whether this thread reads what another process sent: a panic is caught then, and becomes an error.
pub fn is_reading() -> bool {
    READING.get()
}

/// A row that another process sent.
pub(super) struct Received(StructArray);

impl Received {
    /// Reads an Arrow IPC stream of one row.
    ///
    /// # Errors
    /// Why it is none.
    pub fn from_bytes(mut bytes: Buffer) -> Result<Self, String> {
        // Arrow checks what it reads, but asserts on some lengths instead of returning an error.
        READING.set(true);
        let read = catch_unwind(AssertUnwindSafe(|| StreamDecoder::new().decode(&mut bytes)));
        READING.set(false);
        let batch = match read {
            Ok(Ok(Some(batch))) => batch,
            Ok(Ok(None)) => return Err("expected an Arrow stream of one batch, found none in it".into()),
            Ok(Err(error)) => return Err(format!("expected an Arrow stream of one batch, found: {error}")),
            Err(_) => return Err("expected an Arrow stream of one batch, found lengths that do not fit".into()),
        };
        match batch.num_rows() {
            1 => Ok(Received(StructArray::from(batch))),
            n => Err(format!("expected a batch of 1 row, found {n}")),
        }
    }

    /// The names of the columns, to say what came.
    pub fn columns(&self) -> String {
        self.0.column_names().join(", ")
    }

    pub fn struct_at(&self, name: &str) -> Result<&StructArray, String> {
        self.column(name)
    }

    pub fn text(&self, name: &str) -> Result<&str, String> {
        Ok(self.column::<StringArray>(name)?.value(0))
    }

    pub fn u32(&self, name: &str) -> Result<u32, String> {
        Ok(self.column::<UInt32Array>(name)?.value(0))
    }

    pub fn i64(&self, name: &str) -> Result<i64, String> {
        Ok(self.column::<Int64Array>(name)?.value(0))
    }

    pub fn texts(&self, name: &str) -> Result<Vec<String>, String> {
        let texts = self.items::<StringArray>(name)?;
        let texts = texts.iter().map(|text| text.map(str::to_string));
        texts
            .collect::<Option<_>>()
            .ok_or_else(|| format!("column `{name}`: a null among its texts"))
    }

    pub fn i64s(&self, name: &str) -> Result<Vec<i64>, String> {
        Ok(self.items::<Int64Array>(name)?.values().to_vec())
    }

    pub fn u64s(&self, name: &str) -> Result<Vec<u64>, String> {
        Ok(self.items::<UInt64Array>(name)?.values().to_vec())
    }

    fn items<A: Array + Clone + 'static>(&self, name: &str) -> Result<A, String> {
        let items = self.column::<ListArray>(name)?.value(0);
        let typed = items.as_any().downcast_ref::<A>().cloned();
        typed.ok_or_else(|| mismatch::<A>(name, &items.data_type().to_string()))
    }

    fn column<A: Array + 'static>(&self, name: &str) -> Result<&A, String> {
        let column = self.0.column_by_name(name);
        let column = column.ok_or_else(|| mismatch::<A>(name, &format!("none (it has: {})", self.columns())))?;
        let typed = column.as_any().downcast_ref::<A>();
        match typed.ok_or_else(|| mismatch::<A>(name, &column.data_type().to_string()))? {
            null if null.is_null(0) => Err(mismatch::<A>(name, "null")),
            typed => Ok(typed),
        }
    }
}

fn mismatch<A>(name: &str, found: &str) -> String {
    let expected = std::any::type_name::<A>().rsplit(['<', ':']).next().unwrap_or_default();
    format!(
        "column `{name}`: expected {}, found {found}",
        expected.trim_end_matches('>')
    )
}
