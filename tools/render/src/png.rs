//! Drawings as PNG files. These few lines, on libraries that the program links anyway, are all of the format that it needs; the
//! crate `png` would add a decoder, filters and a second compressor to every build.

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use crate::drawing::Drawing;
use crate::pixels::Pixels;

const SIGNATURE: [u8; 8] = [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a];
/// Eight bits for each of red, green and blue; deflate, plain filters, not interlaced.
const FORM: [u8; 5] = [8, 2, 0, 0, 0];

/// A drawing as a PNG file, a pixel for each px.
pub fn png(drawing: &Drawing) -> Vec<u8> {
    let pixels = Pixels::of(drawing);
    let mut header = Vec::new();
    header.extend(pixels.width.to_be_bytes());
    header.extend(pixels.height.to_be_bytes());
    header.extend(FORM);
    let mut file = SIGNATURE.to_vec();
    chunk(&mut file, b"IHDR", &header);
    chunk(&mut file, b"IDAT", &compressed(&pixels));
    chunk(&mut file, b"IEND", &[]);
    file
}

/// Colours are rounded to multiples of this, which nobody sees: files are a third smaller.
const STEP: u8 = 8;

/// Rows as they are (filter 0): most of a drawing is of few colours, which no filter makes smaller.
fn compressed(pixels: &Pixels) -> Vec<u8> {
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    for row in pixels.rgb.chunks_exact(pixels.width as usize) {
        let row: Vec<u8> = row.as_flattened().iter().copied().map(rounded).collect();
        let written = encoder.write_all(&[0]).and_then(|()| encoder.write_all(&row));
        written.expect("memory takes all");
    }
    encoder.finish().expect("memory takes all")
}

fn rounded(channel: u8) -> u8 {
    (channel.saturating_add(STEP / 2) / STEP).saturating_mul(STEP)
}

fn chunk(file: &mut Vec<u8>, kind: &[u8; 4], data: &[u8]) {
    file.extend((data.len() as u32).to_be_bytes());
    let mut checked = kind.to_vec();
    checked.extend(data);
    file.extend(&checked);
    file.extend(crc32fast::hash(&checked).to_be_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::style;

    #[test]
    fn another_decoder_reads_the_same_pixels() {
        let mut drawing = Drawing {
            size: [40.0, 30.0],
            title: String::new(),
            ground: style::GROUND,
            items: Vec::new(),
        };
        drawing.mark("square", "M5 5L31.5 7L22 27Z".into(), style::ADDED);
        let pixels = Pixels::of(&drawing);
        let file = png(&drawing);
        let header = minipng::decode_png_header(&file).unwrap();
        assert_eq!((header.width(), header.height()), (40, 30));
        let mut buffer = vec![0; header.required_bytes()];
        let image = minipng::decode_png(&file, &mut buffer).unwrap();
        let near = |(a, b): (&u8, &u8)| a.abs_diff(*b) <= STEP;
        assert_eq!(image.pixels().len(), pixels.rgb.len() * 3);
        assert!(image.pixels().iter().zip(pixels.rgb.as_flattened()).all(near));
    }
}
