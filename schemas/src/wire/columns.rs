//! Building and reading the columns of a one-row struct array.

use super::*;
use arrow_buffer::Buffer;

/// Collects the columns of one row.
#[derive(Default)]
pub(super) struct Builder {
    fields: Vec<Field>,
    columns: Vec<ArrayRef>,
}

impl Builder {
    pub(super) fn push(&mut self, name: &str, column: impl Array + 'static) {
        self.push_owned(name.to_string(), Arc::new(column));
    }

    pub(super) fn push_owned(&mut self, name: String, column: ArrayRef) {
        self.fields.push(Field::new(name, column.data_type().clone(), true));
        self.columns.push(column);
    }

    pub(super) fn list(&mut self, name: &str, values: impl Array + 'static) {
        self.push(name, list_of(Arc::new(values)));
    }

    pub(super) fn text(&mut self, name: &str, text: &str) {
        self.push(name, StringArray::from(vec![text]));
    }

    pub(super) fn list_text<'a>(&mut self, name: &str, texts: impl Iterator<Item = &'a str>) {
        self.list(name, StringArray::from_iter_values(texts));
    }

    pub(super) fn list_i64(&mut self, name: &str, values: Vec<i64>) {
        self.list(name, Int64Array::from(values));
    }

    pub(super) fn list_f64(&mut self, name: &str, values: Vec<f64>) {
        self.list(name, Float64Array::from(values));
    }

    pub(super) fn bytes(&mut self, name: &str, bytes: &Buffer) {
        let offsets = OffsetBuffer::from_lengths([bytes.len()]);
        self.push(name, BinaryArray::new(offsets, bytes.clone(), None));
    }

    pub(super) fn finish(self) -> StructArray {
        StructArray::new(Fields::from(self.fields), self.columns, None)
    }
}

/// One list that holds all values.
pub(super) fn list_of(values: ArrayRef) -> ListArray {
    let field = Arc::new(Field::new("item", values.data_type().clone(), true));
    ListArray::new(field, OffsetBuffer::from_lengths([values.len()]), values, None)
}

/// One row of a struct array.
pub(super) struct Row<'a> {
    rows: &'a StructArray,
    index: usize,
}

impl<'a> Row<'a> {
    pub(super) fn new(rows: &'a StructArray, index: usize) -> Self {
        Row { rows, index }
    }

    pub(super) fn index(&self) -> usize {
        self.index
    }

    pub(super) fn optional(&self, field: &str) -> Option<&'a ArrayRef> {
        self.rows.column_by_name(field)
    }

    /// The column of a field; its value at this row is not null.
    pub(super) fn value<A: Array + 'static>(&self, field: &str) -> Result<&'a A, WireError> {
        let column = self.optional(field);
        let typed = column.and_then(|column| column.as_any().downcast_ref::<A>());
        let typed = typed.ok_or_else(|| mismatch::<A>(field, column))?;
        if typed.is_null(self.index) {
            return Err(WireError::content(field, "is null"));
        }
        Ok(typed)
    }

    pub(super) fn text(&self, field: &str) -> Result<&'a str, WireError> {
        Ok(self.value::<StringArray>(field)?.value(self.index))
    }

    /// The values of a list field, sharing their memory.
    pub(super) fn list<A: Array + Clone + 'static>(&self, field: &str) -> Result<A, WireError> {
        let values = self.value::<ListArray>(field)?.value(self.index);
        let typed = values.as_any().downcast_ref::<A>().cloned();
        typed.ok_or_else(|| mismatch::<A>(field, Some(&values)))
    }

    pub(super) fn list_i64(&self, field: &str) -> Result<Vec<i64>, WireError> {
        Ok(self.list::<Int64Array>(field)?.values().to_vec())
    }

    pub(super) fn list_f64(&self, field: &str) -> Result<Vec<f64>, WireError> {
        Ok(self.list::<Float64Array>(field)?.values().to_vec())
    }

    pub(super) fn texts(&self, field: &str) -> Result<Vec<&'a str>, WireError> {
        let lists = self.value::<ListArray>(field)?;
        let values = lists.values();
        let texts = values.as_any().downcast_ref::<StringArray>();
        let texts = texts.ok_or_else(|| mismatch::<StringArray>(field, Some(values)))?;
        let (start, end) = (lists.value_offsets()[self.index], lists.value_offsets()[self.index + 1]);
        Ok((start as usize..end as usize).map(|i| texts.value(i)).collect())
    }

    /// The bytes of a binary field, sharing their memory.
    pub(super) fn bytes(&self, field: &str) -> Result<Buffer, WireError> {
        let column = self.value::<BinaryArray>(field)?;
        let (start, end) = (
            column.value_offsets()[self.index],
            column.value_offsets()[self.index + 1],
        );
        Ok(column
            .values()
            .slice_with_length(start as usize, (end - start) as usize))
    }
}

/// A vector of fixed size at `index`, `None` where it is null.
pub(super) fn vector<const N: usize>(
    lists: &FixedSizeListArray,
    index: usize,
    field: &str,
) -> Result<Option<[f64; N]>, WireError> {
    if lists.is_null(index) {
        return Ok(None);
    }
    let values = lists.value(index);
    let values = values.as_any().downcast_ref::<Float64Array>();
    let vector = values.and_then(|values| <[f64; N]>::try_from(&values.values()[..]).ok());
    vector
        .map(Some)
        .ok_or_else(|| WireError::content(field, format!("needs {N} numbers of type Float64")))
}

fn mismatch<A>(field: &str, found: Option<&ArrayRef>) -> WireError {
    let expected = std::any::type_name::<A>().rsplit(['<', ':']).next().unwrap_or_default();
    WireError::Field {
        field: field.into(),
        expected: expected.trim_end_matches('>').into(),
        found: found.map_or("nothing".into(), |column| column.data_type().to_string()),
    }
}
