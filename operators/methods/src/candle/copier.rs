//! From the device to the host: masked and quantised on the device, so that fewer bytes cross.

use candle_core::{DType, Result, Tensor};
use realo_kernels::bev::BevMap;

/// Steps between the smallest and the largest code.
const STEPS: f64 = 255.0;

/// Numbers of maps as they cross from the device to the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Elements {
    /// Single precision.
    F32,
    /// Half precision.
    F16,
    /// A byte, with the least number and the step of each channel.
    Int8,
}

/// Copies maps of one network to the host. Cells that say what they say of an empty sweep are masked: they stay on the device,
/// and the host puts its own copy of them in their place.
pub struct Copier {
    elements: Elements,
    /// `[cells, channels]`: the map of an empty sweep, on the device and on the host.
    empty: Tensor,
    on_host: Vec<f32>,
}

/// What is to cross, still on the device.
pub struct Taken {
    size: [usize; 3],
    /// The cells that cross, of all.
    cells: Vec<u32>,
    /// `[cells that cross, channels]`, if any do.
    elements: Option<Tensor>,
    /// Smallest number and step of each channel, of codes.
    scales: Option<[Tensor; 2]>,
}

/// A map on the host.
pub struct Copied {
    /// The map.
    pub map: BevMap,
    /// Bytes of elements that crossed.
    pub bytes: usize,
}

impl Copier {
    /// `empty`: the map of an empty sweep, `[rows, columns, channels]`.
    ///
    /// # Errors
    /// Those of candle.
    pub fn new(elements: Elements, empty: &Tensor) -> Result<Self> {
        let empty = empty.flatten_to(1)?;
        Ok(Copier {
            elements,
            on_host: empty.flatten_all()?.to_vec1()?,
            empty,
        })
    }

    /// Masks and quantises a map, `[rows, columns, channels]` in f32. Only the mask leaves the device, a byte for each cell.
    ///
    /// # Errors
    /// Those of candle.
    pub fn take(&self, map: &Tensor) -> Result<Taken> {
        let (rows, columns, channels) = map.dims3()?;
        let numbers = map.flatten_to(1)?;
        let (elements, empty, scales) = match self.elements {
            Elements::F32 => (numbers, self.empty.clone(), None),
            Elements::F16 => (half(&numbers)?, half(&self.empty)?, None),
            Elements::Int8 => {
                let scales = Scales::of(&numbers)?;
                let codes = [&numbers, &self.empty].map(|numbers| scales.codes(numbers));
                let [elements, empty] = codes;
                (elements?, empty?, Some([scales.min, scales.step]))
            }
        };
        let says_more: Vec<u8> = elements.ne(&empty)?.max(1)?.to_vec1()?;
        let cells = (0..)
            .zip(says_more)
            .filter(|(_, more)| *more != 0)
            .map(|(cell, _)| cell);
        let cells: Vec<u32> = cells.collect();
        let elements = match cells.len() {
            crossing if crossing == rows * columns => Some(elements),
            0 => None,
            crossing => Some(elements.index_select(&Tensor::from_slice(&cells, crossing, map.device())?, 0)?),
        };
        let size = [rows, columns, channels];
        Ok(Taken {
            size,
            cells,
            elements,
            scales,
        })
    }

    /// Copies what was taken and puts the map together.
    ///
    /// # Errors
    /// Those of candle.
    pub fn copy(&self, taken: &Taken) -> Result<Copied> {
        let [rows, columns, channels] = taken.size;
        let (mut data, mut bytes) = (self.on_host.clone(), 0);
        if let Some(elements) = &taken.elements {
            bytes = elements.elem_count() * elements.dtype().size_in_bytes();
            let crossed = elements.flatten_all()?;
            match &taken.scales {
                None => fill(&mut data, taken, &numbers(&crossed)?, |number, _| number),
                Some([min, step]) => {
                    let [min, step] = [min, step].map(|scale| scale.to_vec1::<f32>());
                    let (min, step) = (min?, step?);
                    let number = |code: u8, channel: usize| min[channel] + f32::from(code) * step[channel];
                    fill(&mut data, taken, &crossed.to_vec1::<u8>()?, number);
                }
            }
        }
        let map = BevMap {
            rows,
            columns,
            channels,
            data,
        };
        Ok(Copied { map, bytes })
    }
}

/// Puts elements that crossed to their cells.
fn fill<E: Copy>(data: &mut [f32], taken: &Taken, elements: &[E], number: impl Fn(E, usize) -> f32) {
    let channels = taken.size[2];
    for (cell, elements) in taken.cells.iter().zip(elements.chunks_exact(channels)) {
        let to = &mut data[*cell as usize * channels..][..channels];
        for (channel, (to, element)) in to.iter_mut().zip(elements).enumerate() {
            *to = number(*element, channel);
        }
    }
}

/// Numbers that crossed as such.
fn numbers(crossed: &Tensor) -> Result<Vec<f32>> {
    let on_host = crossed.to_device(&candle_core::Device::Cpu)?;
    on_host.to_dtype(DType::F32)?.to_vec1()
}

/// In half precision, bounded by its largest number.
fn half(numbers: &Tensor) -> Result<Tensor> {
    const GREATEST: f32 = 65_504.0;
    numbers.clamp(-GREATEST, GREATEST)?.to_dtype(DType::F16)
}

/// What a code of each channel means: `smallest + code * step`.
struct Scales {
    min: Tensor,
    step: Tensor,
}

impl Scales {
    fn of(numbers: &Tensor) -> Result<Self> {
        let min = numbers.min(0)?;
        let step = ((numbers.max(0)? - &min)? / STEPS)?;
        // One over a lesser step would not be finite.
        let step = step.maximum(f64::from(f32::MIN_POSITIVE))?;
        Ok(Scales { min, step })
    }

    fn codes(&self, numbers: &Tensor) -> Result<Tensor> {
        let steps = numbers.broadcast_sub(&self.min)?.broadcast_div(&self.step)?;
        steps.round()?.clamp(0.0, STEPS)?.to_dtype(DType::U8)
    }
}
