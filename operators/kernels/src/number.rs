//! Number types of maps, and how they take maps of f32.

use crate::conv::{Bf16, Kernel, Map, Pool, U8, View};

/// How a number type takes a map of f32.
pub trait Number: Kernel<Self> + Kernel<f32> {
    /// The map as it lies, or as a copy with a border in this type, in steps.
    fn take<'a>(
        from: View<'a, f32>,
        needs_border: bool,
        step: f32,
        copy: &'a mut Option<Copied<Self>>,
        pool: &mut Pool,
    ) -> View<'a, Self>;
}

impl Number for f32 {
    fn take<'a>(
        from: View<'a, f32>,
        needs_border: bool,
        step: f32,
        copy: &'a mut Option<Copied<f32>>,
        pool: &mut Pool,
    ) -> View<'a, f32> {
        match from.border == 1 || !needs_border {
            true => from,
            false => copied(from, step, copy, pool),
        }
    }
}

macro_rules! always_copied {
    ($element:ty) => {
        impl Number for $element {
            fn take<'a>(
                from: View<'a, f32>,
                _: bool,
                step: f32,
                copy: &'a mut Option<Copied<$element>>,
                pool: &mut Pool,
            ) -> View<'a, $element> {
                copied(from, step, copy, pool)
            }
        }
    };
}
always_copied!(Bf16);
always_copied!(U8);

/// A copy of a map in other numbers.
pub struct Copied<E> {
    map: Map<E>,
    /// Where cells of the map that it was taken from began that may differ from zero; `None`: anywhere.
    written: Option<Vec<usize>>,
}

fn copied<'a, E: Number>(from: View<f32>, step: f32, copy: &'a mut Option<Copied<E>>, pool: &mut Pool) -> View<'a, E> {
    let Copied { map, written } = copy.get_or_insert_with(|| Copied {
        map: Map::with_step([from.rows, from.columns, from.stored], step),
        written: Some(Vec::new()),
    });
    match (from.border, from.written, &written) {
        (0, _, _) => map.fill_with(pool, from.data),
        (_, Some(cells), Some(before)) => map.fill_from_cells(pool, from, before, cells),
        _ => map.fill_from_view(pool, from),
    }
    let kept = written.take().unwrap_or_default();
    *written = from.written.map(|cells| {
        let mut kept = kept;
        kept.clear();
        kept.extend_from_slice(cells);
        kept
    });
    map.view()
}
