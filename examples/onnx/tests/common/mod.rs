//! Writes small ONNX files: the messages of protobuf that they are, by the numbers of onnx.proto.

use std::path::{Path, PathBuf};

/// Number of a type of elements.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// float32
    Float = 1,
    /// int32
    Int32 = 6,
    /// int64
    Int64 = 7,
    /// bool
    Bool = 9,
}

/// A message of protobuf.
#[derive(Clone, Default)]
pub struct Bytes(Vec<u8>);

impl Bytes {
    fn number(mut self, field: u64, value: u64) -> Self {
        self.varint(field << 3);
        self.varint(value);
        self
    }

    fn inner(mut self, field: u64, bytes: &[u8]) -> Self {
        self.varint(field << 3 | 2);
        self.varint(bytes.len() as u64);
        self.0.extend(bytes);
        self
    }

    fn text(self, field: u64, text: &str) -> Self {
        self.inner(field, text.as_bytes())
    }

    fn varint(&mut self, mut value: u64) {
        while value > 0x7f {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }
}

/// A file in the making.
#[derive(Clone, Default)]
pub struct File {
    graph: Bytes,
}

impl File {
    /// Adds an input; a dimension is a number or a name.
    pub fn input(mut self, name: &str, kind: Kind, dimensions: &[&str]) -> Self {
        self.graph = self.graph.inner(11, &port(name, kind, dimensions).0);
        self
    }

    /// Adds an output.
    pub fn output(mut self, name: &str, kind: Kind, dimensions: &[&str]) -> Self {
        self.graph = self.graph.inner(12, &port(name, kind, dimensions).0);
        self
    }

    /// Adds a constant of whole numbers.
    pub fn whole(mut self, name: &str, numbers: &[i64]) -> Self {
        let raw: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
        let tensor = Bytes::default()
            .number(1, numbers.len() as u64)
            .number(2, Kind::Int64 as u64);
        self.graph = self.graph.inner(5, &tensor.text(8, name).inner(9, &raw).0);
        self
    }

    /// Adds a constant of floats that are in a file beside this one, from its first byte on.
    pub fn elsewhere(mut self, name: &str, dimensions: &[u64], file: &str) -> Self {
        let tensor = dimensions
            .iter()
            .fold(Bytes::default(), |tensor, n| tensor.number(1, *n));
        let tensor = tensor.number(2, Kind::Float as u64).text(8, name).number(14, 1);
        let length = 4 * dimensions.iter().product::<u64>();
        let pairs = [
            ("location", file.to_string()),
            ("offset", "0".into()),
            ("length", length.to_string()),
        ];
        let tensor = pairs.iter().fold(tensor, |tensor, (key, value)| {
            tensor.inner(13, &Bytes::default().text(1, key).text(2, value).0)
        });
        self.graph = self.graph.inner(5, &tensor.0);
        self
    }

    /// Adds an operator with attributes of whole numbers.
    pub fn node(mut self, operator: &str, inputs: &[&str], output: &str, attributes: &[(&str, &[i64])]) -> Self {
        let mut node = inputs.iter().fold(Bytes::default(), |node, input| node.text(1, input));
        node = node.text(2, output).text(3, output).text(4, operator);
        for (name, numbers) in attributes {
            let attribute = Bytes::default().text(1, name);
            let attribute = match numbers {
                [one] if !["axes", "perm"].contains(name) => attribute.number(3, *one as u64).number(20, 2),
                many => many
                    .iter()
                    .fold(attribute, |attribute, n| attribute.number(8, *n as u64))
                    .number(20, 7),
            };
            node = node.inner(5, &attribute.0);
        }
        self.graph = self.graph.inner(1, &node.0);
        self
    }

    /// Writes it.
    pub fn write(self, folder: &Path, name: &str) -> PathBuf {
        let path = folder.join(name);
        let opset = Bytes::default().text(1, "").number(2, 17);
        let model = Bytes::default().number(1, 8).inner(8, &opset.0);
        let model = model.inner(7, &self.graph.text(2, "small").0);
        std::fs::write(&path, model.0).expect("it can be written");
        path
    }
}

fn port(name: &str, kind: Kind, dimensions: &[&str]) -> Bytes {
    let shape = dimensions.iter().fold(Bytes::default(), |shape, dimension| {
        let one = match dimension.parse() {
            Ok(fixed) => Bytes::default().number(1, fixed),
            Err(_) => Bytes::default().text(2, dimension),
        };
        shape.inner(1, &one.0)
    });
    let tensor = Bytes::default().number(1, kind as u64).inner(2, &shape.0);
    Bytes::default()
        .text(1, name)
        .inner(2, &Bytes::default().inner(1, &tensor.0).0)
}
