//! Several drawings as one.

use crate::drawing::{Drawing, Item};
use crate::style::{GROUND, Line, Style};
use crate::view::{Px, line, number};

/// Between drawings.
const EDGE: Style = Style {
    line: Some(Line::new("#39485a", 2.0)),
    fill: None,
};

/// Drawings side by side, from left to right; more than two in as many rows as columns, or one less.
pub fn beside(drawings: Vec<Drawing>) -> Drawing {
    let columns = (1..).find(|columns| columns * columns >= drawings.len()).unwrap_or(1);
    let titles: Vec<&str> = drawings.iter().map(|drawing| drawing.title.as_str()).collect();
    let mut all = Drawing {
        size: [0.0, 0.0],
        title: titles.join(" | "),
        ground: GROUND,
        items: Vec::new(),
    };
    let mut rest = drawings.into_iter().peekable();
    let mut edges = Vec::new();
    while rest.peek().is_some() {
        let row: Vec<Drawing> = rest.by_ref().take(columns).collect();
        let top = all.size[1];
        let height = row.iter().map(|drawing| drawing.size[1]).fold(0.0, f64::max);
        let mut left = 0.0;
        for drawing in row {
            if left > 0.0 {
                edges.push(line([left, top], [left, top + height]));
            }
            let width = drawing.size[0];
            all.items
                .extend(drawing.items.into_iter().map(|item| shifted(item, [left, top])));
            left += width;
        }
        if top > 0.0 {
            edges.push(line([0.0, top], [left.max(all.size[0]), top]));
        }
        all.size = [all.size[0].max(left), top + height];
    }
    if !edges.is_empty() {
        all.mark("edge", edges.concat(), EDGE);
    }
    all
}

fn shifted(item: Item, by: Px) -> Item {
    match item {
        Item::Mark(mut mark) => {
            mark.path = shifted_path(&mark.path, by);
            Item::Mark(mark)
        }
        Item::Dots(mut dots) => {
            dots.origin = [dots.origin[0] + by[0], dots.origin[1] + by[1]];
            Item::Dots(dots)
        }
    }
}

/// Path data somewhere else. All that is drawn here has commands with pairs of absolute numbers, one space apart.
fn shifted_path(path: &str, by: Px) -> String {
    let mut moved = String::with_capacity(path.len() + path.len() / 4);
    for (at, part) in path
        .split_inclusive(|letter: char| letter.is_ascii_alphabetic())
        .enumerate()
    {
        // What is before a command are the numbers of the one before.
        let (numbers, command) = match part.char_indices().next_back() {
            Some((end, letter)) if letter.is_ascii_alphabetic() => (&part[..end], &part[end..]),
            _ => (part, ""),
        };
        debug_assert!(at > 0 || numbers.is_empty(), "a path begins with a command");
        let places = numbers.split(' ').filter_map(|text| text.parse::<f64>().ok());
        let places: Vec<String> = places
            .zip([0, 1].iter().cycle())
            .map(|(place, axis)| number(place + by[*axis]))
            .collect();
        moved.push_str(&places.join(" "));
        moved.push_str(command);
    }
    moved
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drawing::Dots;

    fn drawing(size: Px) -> Drawing {
        let mut drawing = Drawing {
            size,
            title: "one".into(),
            ground: GROUND,
            items: Vec::new(),
        };
        drawing.mark("box", "M1 2L-3.5 4Q1 2 3 4C1 2 3 4 5 6ZM0 0L1 1".into(), EDGE);
        drawing.items.push(Item::Dots(Dots {
            color: GROUND,
            alpha: 1.0,
            diameter: 1.0,
            origin: [5.0, 6.0],
            cell: 1.0,
            cells: vec![[0, 0]],
        }));
        drawing
    }

    #[test]
    fn drawings_stand_in_rows_and_nothing_of_them_changes_but_its_place() {
        let two = beside(vec![drawing([100.0, 50.0]), drawing([100.0, 60.0])]);
        assert_eq!((two.size, two.title.as_str()), ([200.0, 60.0], "one | one"));
        let paths: Vec<&str> = two
            .items
            .iter()
            .filter_map(|item| match item {
                Item::Mark(mark) => Some(&*mark.path),
                Item::Dots(_) => None,
            })
            .collect();
        assert_eq!(paths[0], "M1 2L-3.5 4Q1 2 3 4C1 2 3 4 5 6ZM0 0L1 1");
        assert_eq!(paths[1], "M101 2L96.5 4Q101 2 103 4C101 2 103 4 105 6ZM100 0L101 1");
        let origins = two.items.iter().filter_map(|item| match item {
            Item::Dots(dots) => Some(dots.origin),
            Item::Mark(_) => None,
        });
        assert_eq!(origins.collect::<Vec<_>>(), [[5.0, 6.0], [105.0, 6.0]]);
        let three = beside(vec![
            drawing([100.0, 50.0]),
            drawing([100.0, 60.0]),
            drawing([100.0, 70.0]),
        ]);
        assert_eq!(three.size, [200.0, 130.0]);
        assert_eq!(beside(vec![drawing([100.0, 50.0])]).items.len(), 2, "one has no edge");
    }
}
