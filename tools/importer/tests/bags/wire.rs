//! Messages in the serialisations of ROS, written by hand.

use realo_schemas::Nanos;

/// How numbers, texts and headers are laid out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wire {
    Ros1,
    Little,
    Big,
}

/// A message in the making.
pub struct Out {
    wire: Wire,
    bytes: Vec<u8>,
}

impl Out {
    fn new(wire: Wire) -> Self {
        Out {
            wire,
            bytes: Vec::new(),
        }
    }

    fn put<const N: usize>(&mut self, mut number: [u8; N]) {
        if self.wire != Wire::Ros1 {
            self.bytes.resize(self.bytes.len().next_multiple_of(N), 0);
        }
        if self.wire == Wire::Big {
            number.reverse();
        }
        self.bytes.extend(number);
    }

    pub fn u8(&mut self, value: u8) {
        self.put([value]);
    }

    pub fn u16(&mut self, value: u16) {
        self.put(value.to_le_bytes());
    }

    pub fn u32(&mut self, value: u32) {
        self.put(value.to_le_bytes());
    }

    pub fn f64s(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.put(value.to_le_bytes()));
    }

    pub fn text(&mut self, text: &str) {
        let zero = usize::from(self.wire != Wire::Ros1);
        self.u32((text.len() + zero) as u32);
        self.bytes.extend(text.as_bytes());
        self.bytes.extend(&[0][..zero]);
    }

    pub fn blob(&mut self, blob: &[u8]) {
        self.u32(blob.len() as u32);
        self.bytes.extend(blob);
    }

    pub fn time(&mut self, time: Nanos) {
        self.u32((time / 1_000_000_000) as u32);
        self.u32((time % 1_000_000_000) as u32);
    }

    pub fn header(&mut self, stamp: Nanos, frame: &str) {
        if self.wire == Wire::Ros1 {
            self.u32(7);
        }
        self.time(stamp);
        self.text(frame);
    }
}

/// A message of any serialisation.
pub type Content = std::rc::Rc<dyn Fn(&mut Out)>;

/// The bytes of a message, with the head of CDR where it needs one.
pub fn bytes(wire: Wire, content: &Content) -> Vec<u8> {
    let mut out = Out::new(wire);
    content(&mut out);
    match wire {
        Wire::Ros1 => out.bytes,
        Wire::Little => [&[0, 1, 0, 0][..], &out.bytes].concat(),
        Wire::Big => [&[0, 0, 0, 0][..], &out.bytes].concat(),
    }
}

/// A recorded message.
#[derive(Clone)]
pub struct Recorded {
    pub topic: &'static str,
    /// As ROS 1 calls it.
    pub kind: &'static str,
    pub log_time: Nanos,
    pub content: Content,
}

pub fn recorded(
    topic: &'static str,
    kind: &'static str,
    log_time: Nanos,
    content: impl Fn(&mut Out) + 'static,
) -> Recorded {
    Recorded {
        topic,
        kind,
        log_time,
        content: std::rc::Rc::new(content),
    }
}

/// A pose of x, y, z and yaw.
pub fn seven([x, y, z, yaw]: [f64; 4]) -> [f64; 7] {
    [x, y, z, 0.0, 0.0, (yaw / 2.0).sin(), (yaw / 2.0).cos()]
}

pub fn transform(
    topic: &'static str,
    log_time: Nanos,
    stamp: Nanos,
    names: [&'static str; 2],
    at: [f64; 4],
) -> Recorded {
    recorded(topic, "tf2_msgs/TFMessage", log_time, move |out| {
        out.u32(1);
        out.header(stamp, names[0]);
        out.text(names[1]);
        out.f64s(&seven(at));
    })
}

pub fn odometry(
    topic: &'static str,
    log_time: Nanos,
    stamp: Nanos,
    names: [&'static str; 2],
    at: [f64; 4],
) -> Recorded {
    recorded(topic, "nav_msgs/Odometry", log_time, move |out| {
        out.header(stamp, names[0]);
        out.text(names[1]);
        out.f64s(&seven(at));
        out.f64s(&[0.0; 36 + 6 + 36]);
    })
}

pub fn pose_stamped(topic: &'static str, log_time: Nanos, stamp: Nanos, frame: &'static str, at: [f64; 4]) -> Recorded {
    recorded(topic, "geometry_msgs/PoseStamped", log_time, move |out| {
        out.header(stamp, frame);
        out.f64s(&seven(at));
    })
}

pub fn fix(topic: &'static str, log_time: Nanos, stamp: Nanos, frame: &'static str, geodetic: [f64; 3]) -> Recorded {
    recorded(topic, "sensor_msgs/NavSatFix", log_time, move |out| {
        out.header(stamp, frame);
        out.u8(0);
        out.u16(1);
        out.f64s(&geodetic);
        out.f64s(&[0.0; 9]);
        out.u8(0);
    })
}

pub fn imu(topic: &'static str, log_time: Nanos, stamp: Nanos, frame: &'static str, yaw: f64) -> Recorded {
    recorded(topic, "sensor_msgs/Imu", log_time, move |out| {
        out.header(stamp, frame);
        out.f64s(&seven([0.0, 0.0, 0.0, yaw])[3..]);
        out.f64s(&[0.0; 9 + 3 + 9 + 3 + 9]);
    })
}

/// An object: class, track, pose of its middle, length, width and height.
pub type Object = (&'static str, &'static str, [f64; 4], [f64; 3]);

/// A `Detection3DArray` of ROS 2.
pub fn detections(
    topic: &'static str,
    log_time: Nanos,
    stamp: Nanos,
    frame: &'static str,
    objects: Vec<Object>,
) -> Recorded {
    recorded(topic, "vision_msgs/Detection3DArray", log_time, move |out| {
        out.header(stamp, frame);
        out.u32(objects.len() as u32);
        for (class, track, at, size) in &objects {
            out.header(stamp, frame);
            out.u32(1);
            out.text(class);
            out.f64s(&[0.9]);
            out.f64s(&seven(*at));
            out.f64s(&[0.0; 36]);
            out.f64s(&seven(*at));
            out.f64s(size);
            out.text(track);
        }
    })
}

/// A field of a cloud: name, offset, datatype.
pub type Field = (&'static str, u32, u8);

/// A `PointCloud2` of rows that may be padded, in either byte order.
pub struct Cloud {
    pub fields: Vec<Field>,
    pub step: u32,
    pub rows: Vec<Vec<u8>>,
    pub row_step: u32,
    pub big_endian: bool,
}

pub fn cloud(topic: &'static str, log_time: Nanos, stamp: Nanos, frame: &'static str, cloud: Cloud) -> Recorded {
    recorded(topic, "sensor_msgs/PointCloud2", log_time, move |out| {
        out.header(stamp, frame);
        out.u32(cloud.rows.len() as u32);
        out.u32(cloud.rows.first().map_or(0, |row| row.len() as u32 / cloud.step));
        out.u32(cloud.fields.len() as u32);
        for (name, offset, datatype) in &cloud.fields {
            out.text(name);
            out.u32(*offset);
            out.u8(*datatype);
            out.u32(1);
        }
        out.u8(u8::from(cloud.big_endian));
        out.u32(cloud.step);
        out.u32(cloud.row_step);
        let mut data = cloud.rows.clone();
        data.iter_mut()
            .for_each(|row| row.resize(cloud.row_step as usize, 0xee));
        out.blob(&data.concat());
        out.u8(0);
    })
}

/// A cube, or a marker of another type: its namespace, id, type, and pose of its middle.
pub type Marker = (&'static str, u32, u32, [f64; 4]);

/// A `MarkerArray` as the first version of ROS 2 has it, of markers of 4 × 2 × 1.5 m.
pub fn markers(
    topic: &'static str,
    log_time: Nanos,
    stamp: Nanos,
    frame: &'static str,
    markers: Vec<Marker>,
) -> Recorded {
    recorded(topic, "visualization_msgs/MarkerArray", log_time, move |out| {
        out.u32(markers.len() as u32);
        for (namespace, id, kind, at) in &markers {
            out.header(stamp, frame);
            out.text(namespace);
            [*id, *kind, 0].into_iter().for_each(|number| out.u32(number));
            out.f64s(&seven(*at));
            out.f64s(&[4.0, 2.0, 1.5]);
            // Colour, lifetime, and no points, colours, text or mesh.
            [0; 4 + 2].into_iter().for_each(|word| out.u32(word));
            out.u8(0);
            [0; 2].into_iter().for_each(|word| out.u32(word));
            out.text("");
            out.text("");
            out.u8(0);
        }
    })
}
