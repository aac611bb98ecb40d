//! A sweep as a table for the terminal, as CSV and as curves.

use std::collections::BTreeSet;
use std::fmt::{self, Write};
use std::path::Path;
use std::rc::Rc;

use eyre::Result;
use realo_cli::{campaign, write_whole};
use realo_render::{Chart, Curve, Value};
use realo_report::Run;

use super::points::{ALONE, Row, Sweep};

/// A row for each point.
const POINTS: &str = "sweep.csv";
/// A row for each course of a setting: where it does harm.
const MARGINS: &str = "margins.csv";
const NONE: &str = "–";

/// So many runs are.
fn are(count: usize) -> String {
    format!("{} {}", campaign::runs(count), if count == 1 { "is" } else { "are" })
}

/// The course of one graph over the values of a setting, the others being fixed.
struct Course<'a> {
    strategy: String,
    /// Number of the setting.
    vary: usize,
    /// All values; the setting's own is the first of it.
    values: Vec<String>,
    /// By the setting's values.
    rows: Vec<Option<&'a Row>>,
}

/// Where a margin turns negative.
#[derive(Clone, Debug, PartialEq)]
enum Turn {
    Never,
    Everywhere,
    /// It is negative at the first value, and not at all of them.
    AtFirst,
    /// Between two values, and where a straight line between them crosses 0; words have no such place.
    Between(String, String, Option<f64>),
}

impl Sweep {
    /// Writes the tables and curves.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        if self.is_empty() {
            return Ok(());
        }
        write_whole(&folder.join(POINTS), self.csv())?;
        write_whole(&folder.join(MARGINS), self.margins_csv())?;
        for vary in 0..self.vary.len() {
            if self.vary[vary].values.len() > 1 {
                let name = self.vary[vary].name.replace('/', "_");
                realo_render::write(&folder.join(format!("{name}.svg")), &self.chart(vary).draw())?;
                write_whole(&folder.join(format!("{name}.md")), self.markdown(vary))?;
            }
        }
        Ok(())
    }

    /// What is shown on the terminal.
    pub fn table(&self) -> String {
        if self.is_empty() {
            return format!("no point is complete yet: {} missing\n", are(self.missing()));
        }
        let iou = self.iou();
        let mut lines = vec![self.head(&iou)];
        for rows in self.same() {
            lines.push(self.line(&rows, &iou));
        }
        let fixed = self.vary.iter().filter(|vary| vary.values.len() == 1);
        let fixed: Vec<String> = fixed.map(|vary| format!("{}={}", vary.name, vary.values[0])).collect();
        let mut text = match fixed.is_empty() {
            true => aligned(&lines),
            false => format!("at {}\n{}", fixed.join(", "), aligned(&lines)),
        };
        let harm = self.harm(&iou);
        if harm.len() > 1 {
            let _ = write!(
                text,
                "\ndo no harm: mAP@{iou} of fused boxes minus that of the ego alone\n{}",
                aligned(&harm)
            );
        }
        let over = match self.over {
            "logs" => "logs",
            _ => "blocks of neighbouring scored frames of one log",
        };
        let _ = write!(
            text,
            "\nmAP@{iou}: mean of the classes' AP, where boxes that overlap by {iou} are the same.\ninterval: 95 %, by resampling \
             {over}.\nmargin: minus the ego alone ({ALONE}).\nage: of half of the data that were fused it is not \
             higher.\n"
        );
        let unknown: BTreeSet<String> = self.rows.iter().flat_map(|row| row.unknown(&iou)).collect();
        if !unknown.is_empty() {
            let unknown: Vec<String> = unknown.into_iter().collect();
            let _ = writeln!(
                text,
                "no objects of {}: mAP is the mean of the other classes",
                unknown.join(", ")
            );
        }
        if self.missing() > 0 {
            let _ = writeln!(
                text,
                "{} missing: points without all their runs have no numbers",
                are(self.missing())
            );
        }
        text
    }

    fn head(&self, iou: &str) -> Vec<String> {
        let first = std::iter::once("strategy".to_string());
        let varied = self.vary.iter().filter(|vary| vary.values.len() > 1);
        let varied = varied.map(|vary| vary.name.clone());
        let rest = [
            format!("mAP@{iou}"),
            "interval".into(),
            "margin".into(),
            "KB/frame".into(),
            "age, ms".into(),
        ];
        first.chain(varied).chain(rest).collect()
    }

    /// Rows of the same runs together: of a graph without a place for a setting.
    fn same(&self) -> Vec<Vec<&Row>> {
        let mut all: Vec<Vec<&Row>> = Vec::new();
        for row in &self.rows {
            let is_same = |rows: &&mut Vec<&Row>| match (&rows[0].run, &row.run) {
                (Some(one), Some(other)) => Rc::ptr_eq(one, other) && rows[0].point.strategy == row.point.strategy,
                _ => false,
            };
            match all.iter_mut().find(is_same) {
                Some(rows) => rows.push(row),
                None => all.push(vec![row]),
            }
        }
        all
    }

    /// The values of a setting in rows of the same runs.
    fn values(&self, vary: usize, rows: &[&Row]) -> String {
        let mut values: Vec<&str> = Vec::new();
        for row in rows {
            let value = row.point.values[vary].as_str();
            if !values.contains(&value) {
                values.push(value);
            }
        }
        match values.len() > 1 && values.len() == self.vary[vary].values.len() {
            true => "any".into(),
            false => values.join(" "),
        }
    }

    fn line(&self, rows: &[&Row], iou: &str) -> Vec<String> {
        let row = rows[0];
        let three = |value: Option<f64>| value.map_or(NONE.into(), |value| format!("{value:.3}"));
        let interval = row.interval(iou);
        let margin = self.margin(row, iou).filter(|_| row.point.strategy != ALONE);
        let of = |field: &str, places: usize| {
            let run: &Run = row.run.as_deref()?;
            let fields = realo_report::fields(&[run]);
            let (_, values) = fields.into_iter().find(|(name, _)| name == field)?;
            let number: f64 = values.first()?.parse().ok()?;
            Some(format!("{number:.places$}"))
        };
        let first = std::iter::once(row.point.strategy.clone());
        let rest = [
            three(row.mean_ap(iou)),
            interval.map_or(NONE.into(), |[low, high]| format!("{low:.3}–{high:.3}")),
            margin.map_or(NONE.into(), |margin| format!("{margin:+.3}")),
            of("KB_per_frame", 1).unwrap_or(NONE.into()),
            of("age_ms", 0).unwrap_or(NONE.into()),
        ];
        let varied = (0..self.vary.len()).filter(|vary| self.vary[*vary].values.len() > 1);
        let values = varied.map(|vary| self.values(vary, rows));
        first.chain(values).chain(rest).collect()
    }

    fn harm(&self, iou: &str) -> Vec<Vec<String>> {
        let head = ["strategy", "setting", "others", "lowest margin", "at", "turns negative"];
        let mut lines = vec![head.map(String::from).to_vec()];
        for course in self.courses().iter().filter(|course| course.strategy != ALONE) {
            let Some((at, margin)) = self.lowest(course, iou) else {
                continue;
            };
            let turn = self.turn(course, iou).to_string();
            let (setting, others) = (self.vary[course.vary].name.clone(), self.others(course));
            lines.push(vec![
                course.strategy.clone(),
                setting,
                others,
                format!("{margin:+.3}"),
                at,
                turn,
            ]);
        }
        lines
    }

    /// Every course: of each graph over each setting, for all values of the other settings.
    fn courses(&self) -> Vec<Course<'_>> {
        let mut courses = Vec::new();
        for (vary, varied) in self
            .vary
            .iter()
            .enumerate()
            .filter(|(_, varied)| varied.values.len() > 1)
        {
            for row in self
                .rows
                .iter()
                .filter(|row| row.point.values[vary] == varied.values[0])
            {
                let at = |value: &String| {
                    let mut values = row.point.values.clone();
                    values[vary].clone_from(value);
                    self.row(&row.point.strategy, &values)
                };
                courses.push(Course {
                    strategy: row.point.strategy.clone(),
                    vary,
                    values: row.point.values.clone(),
                    rows: varied.values.iter().map(at).collect(),
                });
            }
        }
        courses
    }

    /// The values of the other settings in words.
    fn others(&self, course: &Course) -> String {
        let named = self.vary.iter().zip(&course.values).enumerate();
        let others = named.filter(|(at, (vary, _))| *at != course.vary && vary.values.len() > 1);
        let words: Vec<String> = others
            .map(|(_, (vary, value))| format!("{}={value}", vary.name))
            .collect();
        words.join(" ")
    }

    /// The margins of a course by the values of its setting, in the order of numbers.
    fn margins(&self, course: &Course, iou: &str) -> Vec<(String, f64)> {
        let values = self.vary[course.vary].values.iter().zip(&course.rows);
        let mut margins: Vec<(String, f64)> = values
            .filter_map(|(value, row)| Some((value.clone(), self.margin((*row)?, iou)?)))
            .collect();
        let number = |value: &str| value.parse::<f64>().ok();
        if margins.iter().all(|(value, _)| number(value).is_some()) {
            margins.sort_by(|(a, _), (b, _)| number(a).unwrap_or(0.0).total_cmp(&number(b).unwrap_or(0.0)));
        }
        margins
    }

    fn lowest(&self, course: &Course, iou: &str) -> Option<(String, f64)> {
        let margins = self.margins(course, iou).into_iter();
        margins.min_by(|(_, a), (_, b)| a.total_cmp(b))
    }

    fn turn(&self, course: &Course, iou: &str) -> Turn {
        turn(&self.margins(course, iou))
    }

    /// A row for each point: its values, then all settings and numbers.
    fn csv(&self) -> String {
        let known: Vec<&Run> = self.rows.iter().filter_map(|row| row.run.as_deref()).collect();
        let mut columns: Vec<(String, Vec<String>)> = vec![(
            "strategy".into(),
            self.rows.iter().map(|row| row.point.strategy.clone()).collect(),
        )];
        for (at, vary) in self.vary.iter().enumerate() {
            let values = self.rows.iter().map(|row| row.point.values[at].clone());
            columns.push((vary.name.clone(), values.collect()));
        }
        columns.push(("intervals_over".into(), vec![self.over.to_string(); self.rows.len()]));
        let own: Vec<String> = columns.iter().map(|(name, _)| name.clone()).collect();
        for (name, values) in realo_report::fields(&known) {
            if !own.contains(&name) {
                let mut values = values.into_iter();
                let cells = self.rows.iter().map(|row| row.run.as_ref().and_then(|_| values.next()));
                let cells = cells.map(Option::unwrap_or_default).collect();
                columns.push((name, cells));
            }
        }
        for (name, cell) in self.more_columns() {
            columns.push((name, self.rows.iter().map(|row| exact(cell(row))).collect()));
        }
        let names: Vec<&str> = columns.iter().map(|(name, _)| name.as_str()).collect();
        let mut text = csv_line(&names);
        for row in 0..self.rows.len() {
            let cells: Vec<&str> = columns.iter().map(|(_, cells)| cells[row].as_str()).collect();
            text.push_str(&csv_line(&cells));
        }
        text
    }

    /// Columns that a table of runs does not have: the second order's classes, intervals, and the margin.
    fn more_columns(&self) -> Vec<(String, Cell<'_>)> {
        let mut columns: Vec<(String, Cell)> = Vec::new();
        let runs = self.rows.iter().filter_map(|row| row.run.as_ref());
        let accuracy = runs.filter_map(|run| run.result.accuracy.as_ref()).next();
        let classes: Vec<String> = accuracy
            .map(|known| known.sorted.ap.keys().cloned().collect())
            .unwrap_or_default();
        for iou in self.ious() {
            for class in &classes {
                let (class, iou) = (class.clone(), iou.clone());
                let name = format!("AP_v2x_real_order_{class}_{iou}");
                let cell = move |row: &Row| {
                    let accuracy = row.run.as_ref()?.result.accuracy.as_ref()?;
                    accuracy.v2x_real.ap.get(&class)?.get(&iou).copied().flatten()
                };
                columns.push((name, Box::new(cell)));
            }
            for (end, bound) in ["low", "high"].into_iter().enumerate() {
                for class in &classes {
                    let (class, of) = (class.clone(), iou.clone());
                    let name = format!("AP_{class}_{of}_{bound}");
                    let cell = move |row: &Row| {
                        let intervals = row.run.as_ref()?.result.intervals.as_ref()?;
                        let bounds = intervals.accuracy.sorted.ap.get(&class)?.get(&of).copied().flatten()?;
                        Some(bounds[end])
                    };
                    columns.push((name, Box::new(cell)));
                }
                let of = iou.clone();
                let cell = move |row: &Row| {
                    let intervals = row.run.as_ref()?.result.intervals.as_ref()?;
                    let bounds = intervals.accuracy.v2x_real.mean_ap.get(&of).copied().flatten()?;
                    Some(bounds[end])
                };
                columns.push((format!("mAP_v2x_real_order_{iou}_{bound}"), Box::new(cell)));
            }
            let of = iou.clone();
            columns.push((format!("mean_AP_{iou}"), Box::new(move |row: &Row| row.mean_ap(&of))));
            for (end, bound) in ["low", "high"].into_iter().enumerate() {
                let of = iou.clone();
                let cell = move |row: &Row| Some(row.interval(&of)?[end]);
                columns.push((format!("mean_AP_{iou}_{bound}"), Box::new(cell)));
            }
            let of = iou.clone();
            let alone = move |row: &Row| self.row(ALONE, &row.point.values)?.mean_ap(&of);
            columns.push((format!("ego_alone_mean_AP_{iou}"), Box::new(alone)));
            let of = iou.clone();
            columns.push((
                format!("margin_{iou}"),
                Box::new(move |row: &Row| self.margin(row, &of)),
            ));
        }
        columns
    }

    fn margins_csv(&self) -> String {
        let mut text = csv_line(&[
            "strategy",
            "setting",
            "others",
            "iou",
            "lowest_margin",
            "at",
            "turns_negative",
            "between",
            "and",
            "crosses_zero_at",
        ]);
        for iou in self.ious() {
            for course in self.courses().iter().filter(|course| course.strategy != ALONE) {
                let Some((at, margin)) = self.lowest(course, &iou) else {
                    continue;
                };
                let (turns, one, other, place) = match self.turn(course, &iou) {
                    Turn::Never => ("never", String::new(), String::new(), None),
                    Turn::Everywhere => ("everywhere", String::new(), String::new(), None),
                    Turn::AtFirst => ("at the first value", String::new(), String::new(), None),
                    Turn::Between(one, other, place) => ("between", one, other, place),
                };
                let (setting, others) = (&self.vary[course.vary].name, self.others(course));
                let (margin, place) = (margin.to_string(), exact(place));
                text.push_str(&csv_line(&[
                    &course.strategy,
                    setting,
                    &others,
                    &iou,
                    &margin,
                    &at,
                    turns,
                    &one,
                    &other,
                    &place,
                ]));
            }
        }
        text
    }

    /// The courses over a setting, the others at their first values.
    fn first_courses(&self, vary: usize) -> Vec<Course<'_>> {
        let is_first = |course: &Course| {
            let mut others = self.vary.iter().zip(&course.values).enumerate();
            course.vary == vary && others.all(|(_, (vary, value))| vary.values[0] == *value)
        };
        self.courses().into_iter().filter(is_first).collect()
    }

    /// The curves over a setting as a table in Markdown: a row for each value, and where margins turn negative.
    fn markdown(&self, vary: usize) -> String {
        let (iou, courses) = (self.iou(), self.first_courses(vary));
        let mut lines = vec![vec![self.vary[vary].name.clone()]];
        lines.extend(self.vary[vary].values.iter().map(|value| vec![value.clone()]));
        lines.push(vec!["turns negative".into()]);
        for course in &courses {
            let is_alone = course.strategy == ALONE;
            let cell = |row: &Option<&Row>| {
                let Some((row, mean)) = row.and_then(|row| Some((row, row.mean_ap(&iou)?))) else {
                    return NONE.into();
                };
                let margin = self.margin(row, &iou).filter(|_| !is_alone);
                margin.map_or(format!("{mean:.3}"), |margin| format!("{mean:.3} ({margin:+.3})"))
            };
            let turn = if is_alone {
                NONE.into()
            } else {
                self.turn(course, &iou).to_string()
            };
            let cells = std::iter::once(course.strategy.clone());
            let cells = cells.chain(course.rows.iter().map(cell)).chain([turn]);
            lines.iter_mut().zip(cells).for_each(|(line, cell)| line.push(cell));
        }
        let ruler = format!("|---|{}\n", "---:|".repeat(courses.len()));
        let mut rows = lines.iter().map(|line| format!("| {} |\n", line.join(" | ")));
        let head = rows.next().unwrap_or_default();
        head + &ruler + &rows.collect::<String>()
    }

    /// The curves over a setting, the others at their first values.
    fn chart(&self, vary: usize) -> Chart {
        let iou = self.iou();
        let courses = self.first_courses(vary);
        let value = |row: &Option<&Row>| {
            let row = (*row)?;
            Some(Value {
                value: row.mean_ap(&iou)?,
                interval: row.interval(&iou),
            })
        };
        let curve = |course: &Course| Curve {
            name: match course.strategy == ALONE {
                true => format!("{ALONE} (ego alone)"),
                false => course.strategy.clone(),
            },
            is_reference: course.strategy == ALONE,
            values: course.rows.iter().map(value).collect(),
        };
        let others = courses.first().map(|course| self.others(course)).unwrap_or_default();
        let over = format!("Bands: 95 % intervals by resampling {}.", self.over);
        Chart {
            title: format!("mAP@{iou} over {}", self.vary[vary].name),
            about: match others.is_empty() {
                true => over,
                false => format!("{over} At {others}."),
            },
            x: self.vary[vary].name.clone(),
            y: format!("mAP@{iou}"),
            places: self.vary[vary].values.clone(),
            curves: courses.iter().map(curve).collect(),
        }
    }
}

impl fmt::Display for Turn {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Turn::Never => f.write_str("never"),
            Turn::Everywhere => f.write_str("everywhere"),
            Turn::AtFirst => f.write_str("at the first value, not everywhere"),
            Turn::Between(_, other, None) => write!(f, "at {other}"),
            Turn::Between(one, other, Some(place)) => {
                write!(f, "at about {} (between {one} and {other})", rounded(*place))
            }
        }
    }
}

type Cell<'a> = Box<dyn Fn(&Row) -> Option<f64> + 'a>;

/// Where margins turn negative for the first time.
fn turn(margins: &[(String, f64)]) -> Turn {
    let Some(at) = margins.iter().position(|(_, margin)| *margin < 0.0) else {
        return Turn::Never;
    };
    let Some(before) = at.checked_sub(1) else {
        let is_everywhere = margins.iter().all(|(_, margin)| *margin < 0.0);
        return if is_everywhere { Turn::Everywhere } else { Turn::AtFirst };
    };
    let ((one, good), (other, bad)) = (&margins[before], &margins[at]);
    let place = one.parse::<f64>().ok().zip(other.parse::<f64>().ok());
    let place = place.map(|(from, to)| from + (to - from) * good / (good - bad));
    Turn::Between(one.clone(), other.clone(), place)
}

/// To about three digits.
fn rounded(value: f64) -> String {
    match value.abs() {
        100.0.. => format!("{value:.0}"),
        1.0.. => format!("{value:.1}"),
        _ => format!("{value:.3}"),
    }
}

fn exact(value: Option<f64>) -> String {
    value.map(|value| value.to_string()).unwrap_or_default()
}

fn csv_line(cells: &[&str]) -> String {
    let quoted = |cell: &&str| match cell.contains([',', '"', '\n']) {
        true => format!("\"{}\"", cell.replace('"', "\"\"")),
        false => cell.to_string(),
    };
    let cells: Vec<String> = cells.iter().map(quoted).collect();
    cells.join(",") + "\n"
}

/// Lines of cells below each other.
fn aligned(lines: &[Vec<String>]) -> String {
    let columns = lines.iter().map(Vec::len).max().unwrap_or(0);
    let width = |column: usize| {
        let cells = lines.iter().filter_map(|line| line.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    let used: Vec<usize> = (0..columns)
        .filter(|column| lines.iter().skip(1).any(|line| !line[*column].is_empty()))
        .collect();
    let mut text = String::new();
    for line in lines {
        let cells: Vec<String> = used
            .iter()
            .map(|column| format!("{:<1$}", line[*column], width(*column)))
            .collect();
        let _ = writeln!(text, "{}", cells.join("  ").trim_end());
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    fn margins(all: &[(&str, f64)]) -> Vec<(String, f64)> {
        all.iter().map(|(value, margin)| (value.to_string(), *margin)).collect()
    }

    #[test]
    fn a_margin_turns_negative_where_a_straight_line_crosses_zero() {
        let of = |all: &[(&str, f64)]| turn(&margins(all));
        assert_eq!(of(&[("0", 0.1), ("50", 0.0)]), Turn::Never);
        assert_eq!(of(&[("0", -0.1), ("50", -0.2)]), Turn::Everywhere);
        let between = |one: &str, other: &str, place| Turn::Between(one.into(), other.into(), place);
        assert_eq!(
            of(&[("0", 0.2), ("50", 0.1), ("100", -0.1)]),
            between("50", "100", Some(75.0))
        );
        assert_eq!(
            of(&[("perfect", 0.2), ("paper", -0.1)]),
            between("perfect", "paper", None)
        );
        assert_eq!(of(&[("0", -0.1), ("50", 0.2)]), Turn::AtFirst);
    }

    #[test]
    fn cells_of_csv_are_quoted_where_they_have_to_be() {
        assert_eq!(csv_line(&["a", "b,c", "d\"e"]), "a,\"b,c\",\"d\"\"e\"\n");
    }

    #[test]
    fn columns_without_values_are_left_out() {
        let lines = [["a", "b", "c"], ["x", "", "yy"], ["xxx", "", "y"]];
        let lines: Vec<Vec<String>> = lines.iter().map(|line| line.map(String::from).to_vec()).collect();
        assert_eq!(aligned(&lines), "a    c\nx    yy\nxxx  y\n");
    }
}
