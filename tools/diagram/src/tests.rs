use std::collections::BTreeSet;

use proptest::prelude::*;

use super::*;

fn port(name: &str, payload: &str) -> Port {
    Port {
        name: name.into(),
        payload: payload.into(),
        ..Port::default()
    }
}

fn stage(process: usize, name: &str, inputs: &[&str], outputs: &[&str]) -> Stage {
    Stage {
        process,
        name: name.into(),
        what: format!("operator {name}"),
        inputs: inputs.iter().map(|name| port(name, "")).collect(),
        outputs: outputs.iter().map(|name| port(name, "Boxes")).collect(),
        ..Stage::default()
    }
}

fn wire(from: [usize; 2], to: [usize; 2]) -> Wire {
    let end = |[stage, port]: [usize; 2]| End { stage, port };
    Wire {
        from: end(from),
        to: end(to),
        feedback: false,
    }
}

fn processes(names: &[&str]) -> Vec<Process> {
    let process = |name: &&str| Process {
        name: name.to_string(),
        is_stage: *name == "player",
        ..Process::default()
    };
    names.iter().map(process).collect()
}

/// A player, a lane with a module and a link that feed each other, and a score that takes from all.
fn small() -> Diagram {
    let mut stages = vec![
        stage(3, "results", &["boxes", "truth"], &[]),
        stage(1, "sender", &["boxes"], &["packets"]),
        stage(1, "nms", &["boxes"], &["boxes"]),
        stage(1, "encoder", &["clouds", "heard"], &["features"]),
        stage(0, "player", &[], &["clouds", "truth"]),
        stage(2, "link", &["packets"], &["to_ego", "back"]),
    ];
    stages[2].modules = vec!["detected".into(), "inner".into()];
    stages[3].modules = vec!["detected".into()];
    Diagram {
        title: "small".into(),
        about: vec!["what it is".into()],
        groups: Vec::new(),
        processes: processes(&["player", "others", "v2x", "score"]),
        stages,
        wires: vec![
            wire([4, 0], [3, 0]),
            wire([4, 1], [0, 1]),
            wire([3, 0], [2, 0]),
            wire([2, 0], [1, 0]),
            wire([1, 0], [5, 0]),
            wire([5, 0], [0, 0]),
            Wire {
                feedback: true,
                ..wire([5, 1], [3, 1])
            },
        ],
    }
}

/// What must be so of every picture.
fn check(diagram: &Diagram) {
    let drawn = picture(diagram);
    let page = Rect::new([0.0, 0.0], drawn.size);
    assert_eq!(drawn.boxes.len(), diagram.stages.len());
    assert_eq!(drawn.wires.len(), diagram.wires.len(), "every wire is drawn");
    let processes: Vec<&FrameAt> = drawn.frames.iter().filter(|frame| frame.is_process).collect();
    assert_eq!(processes.len(), diagram.processes.len());
    check_groups(diagram, &drawn, &processes);
    for (at, one) in drawn.boxes.iter().enumerate() {
        assert!(page.holds(&one.rect), "{:?} is outside of {page:?}", one.rect);
        let stage = &diagram.stages[one.stage];
        assert!(processes[stage.process].rect.holds(&one.rect), "{}", stage.name);
        for other in &drawn.boxes[at + 1..] {
            assert!(!one.rect.overlaps(&other.rect), "{one:?} and {other:?}");
        }
        assert_eq!(one.ports.len(), stage.inputs.len() + stage.outputs.len());
        let places: BTreeSet<String> = one.ports.iter().map(|port| format!("{:?}", port.at)).collect();
        assert_eq!(places.len(), one.ports.len(), "no port is on another");
    }
    for (at, one) in drawn.frames.iter().enumerate() {
        assert!(page.holds(&one.rect), "{one:?}");
        for other in &drawn.frames[at + 1..] {
            let within = one.rect.holds(&other.rect) || other.rect.holds(&one.rect);
            assert!(within || !one.rect.overlaps(&other.rect), "{one:?} and {other:?}");
        }
    }
    for at in &drawn.wires {
        let wire = diagram.wires[at.wire];
        let place = |end, is_output| drawn.port(end, is_output).expect("it is drawn").at;
        let short = |value: f64| format!("{}", (value * 10.0).round() / 10.0);
        let [from, to] = [place(wire.from, true), place(wire.to, false)];
        assert!(
            at.path.starts_with(&format!("M{} {}", short(from[0]), short(from[1]))),
            "{}",
            at.path
        );
        assert!(
            at.path.ends_with(&format!("H{}", short(to[0]))),
            "{} to {to:?}",
            at.path
        );
        assert!(!at.path.contains("NaN") && !at.path.contains("inf"), "{}", at.path);
        check_way(diagram, &drawn, at);
    }
    let page = svg(diagram);
    roxmltree::Document::parse(&page).expect("it is XML");
    assert_eq!(page.matches("class=\"wire\"").count(), diagram.wires.len());
    assert_eq!(page, svg(diagram), "a picture is the same every time");
}

/// The frame of a group holds its processes, and nothing of another one.
fn check_groups(diagram: &Diagram, drawn: &Picture, processes: &[&FrameAt]) {
    let page = Rect::new([0.0, 0.0], drawn.size);
    for frame in &drawn.groups {
        assert!(page.holds(&frame.rect) && frame.rect.y >= drawn.top - 40.0, "{frame:?}");
        let group = diagram.groups.iter().position(|group| group.name == frame.name);
        for (process, at) in diagram.processes.iter().zip(processes) {
            match process.group == group {
                true => assert!(frame.rect.holds(&at.rect), "{} is not in {}", at.name, frame.name),
                false => assert!(!frame.rect.overlaps(&at.rect), "{} is in {}", at.name, frame.name),
            }
        }
        let others = drawn.groups.iter().filter(|other| other.name != frame.name);
        others.for_each(|other| assert!(!frame.rect.overlaps(&other.rect), "{frame:?} and {other:?}"));
    }
    let used: BTreeSet<usize> = diagram.processes.iter().filter_map(|process| process.group).collect();
    assert_eq!(drawn.groups.len(), used.len());
}

/// No horizontal part of a wire between processes lies on a process other than its own.
fn check_way(diagram: &Diagram, drawn: &Picture, at: &WireAt) {
    let wire = diagram.wires[at.wire];
    let own = [wire.from, wire.to].map(|end| diagram.stages[end.stage].process);
    let processes = drawn.frames.iter().filter(|frame| frame.is_process).enumerate();
    for part in straight(&at.path) {
        for (process, frame) in processes.clone().filter(|(process, _)| !own.contains(process)) {
            assert!(
                !frame.rect.overlaps(&part),
                "{} runs through {process}: {}",
                at.wire,
                at.path
            );
        }
    }
}

/// The horizontal parts of a path, as thin rectangles.
fn straight(path: &str) -> Vec<Rect> {
    let mut parts = Vec::new();
    let (mut x, mut y) = (0.0, 0.0);
    let mut rest = path;
    while let Some(command) = rest.chars().next() {
        let end = rest[1..]
            .find(|letter: char| letter.is_ascii_uppercase())
            .map_or(rest.len(), |at| at + 1);
        let numbers: Vec<f64> = rest[1..end].split(' ').map(|number| number.parse().unwrap()).collect();
        match command {
            'H' => {
                let (left, right) = (f64::min(x, numbers[0]), f64::max(x, numbers[0]));
                parts.push(Rect::new([left, y - 0.1], [right - left, 0.2]));
                x = numbers[0];
            }
            'V' => y = numbers[0],
            _ => [x, y] = [numbers[numbers.len() - 2], numbers[numbers.len() - 1]],
        }
        rest = &rest[end..];
    }
    parts
}

#[test]
fn a_picture_has_every_stage_port_and_wire_and_nothing_lies_on_another() {
    check(&small());
    check(&Diagram::default());
}

#[test]
fn processes_stand_from_left_to_right_and_stages_below_what_they_take_from() {
    let drawn = picture(&small());
    let frames: Vec<&FrameAt> = drawn.frames.iter().filter(|frame| frame.is_process).collect();
    let order: Vec<&str> = {
        let mut frames = frames.clone();
        frames.sort_by(|a, b| a.rect.x.total_cmp(&b.rect.x));
        frames.iter().map(|frame| frame.name.as_str()).collect()
    };
    assert_eq!(order, ["player", "others", "v2x", "score"]);
    let top = |stage: usize| drawn.boxes.iter().find(|drawn| drawn.stage == stage).unwrap().rect.y;
    assert!(top(3) < top(2) && top(2) < top(1));
    let names: Vec<&str> = drawn.frames.iter().map(|frame| frame.name.as_str()).collect();
    assert!(names.contains(&"detected") && names.contains(&"inner"));
    assert_eq!(small().name_of(2), "others.detected.inner.nms");
    assert_eq!(small().name_of(4), "player");
}

/// The same with the link in one group, and what is around it in another.
fn grouped() -> Diagram {
    let mut diagram = small();
    let group = |name: &str, what: &str| Group {
        name: name.into(),
        what: what.into(),
    };
    diagram.groups = vec![group("scene", "module"), group("air", "module")];
    for (process, group) in diagram.processes.iter_mut().zip([0, 0, 1, 0]) {
        process.group = Some(group);
    }
    diagram
}

#[test]
fn groups_are_framed_one_below_the_other_and_named() {
    let diagram = grouped();
    check(&diagram);
    let drawn = picture(&diagram);
    assert!(drawn.groups[0].rect.y + drawn.groups[0].rect.height < drawn.groups[1].rect.y);
    let page = svg(&diagram);
    assert!(page.contains("class=\"group\"") && page.contains(">scene</text>") && page.contains(">module</text>"));
    assert_eq!(page.matches("class=\"group\"").count(), 2);
    let flow = overview::overview(&diagram, 80);
    let rows: Vec<&str> = flow.lines().collect();
    let at = |words: &str| rows.iter().position(|row| row.contains(words)).expect("it is there");
    assert!(at("┄ scene (module) ┄") < at("│ player │"), "{flow}");
    assert!(at("│ others │") < at("┄ air (module) ┄"), "{flow}");
    assert!(at("┄ air (module) ┄") < at("│ v2x │"), "{flow}");
    let mut some = grouped();
    some.processes[3].group = None;
    some.groups.push(Group::default());
    check(&some);
}

#[test]
fn a_circle_and_a_stage_that_feeds_itself_are_drawn() {
    let mut diagram = small();
    diagram.wires.push(wire([1, 0], [3, 0]));
    diagram.wires.push(wire([2, 0], [2, 0]));
    diagram.wires.push(wire([5, 0], [5, 0]));
    check(&diagram);
}

/// Names that would leave their place, control a terminal, or have letters that the font lacks.
const WILD: &str = "<b>\"it's\" & ]]></text>\u{1b}[31m\n日本";

#[test]
fn names_cannot_leave_their_place() {
    let mut diagram = small();
    diagram.title = WILD.into();
    diagram.about = vec![WILD.into()];
    diagram.processes[0].name = WILD.into();
    diagram.processes[1].what = WILD.into();
    for stage in &mut diagram.stages {
        stage.name = format!("{}{WILD}", stage.name);
        stage.facts = vec![WILD.into()];
        for port in stage.inputs.iter_mut().chain(&mut stage.outputs) {
            port.facts = WILD.into();
            port.payload = WILD.into();
        }
    }
    check(&diagram);
    let page = svg(&diagram);
    assert!(!page.contains("<b>") && page.contains("&lt;b&gt;&quot;it&#39;s&quot; &amp;"));
    let said = text(
        &diagram,
        Terminal {
            width: 80,
            colour: false,
        },
    );
    assert!(said.chars().all(|letter| letter == '\n' || !letter.is_control()));
}

#[test]
fn a_terminal_gets_no_line_that_is_too_long_and_every_end_of_every_wire() {
    let mut diagram = small();
    diagram.stages[5].outputs[0].facts = "20.0 Hz, boxes 109.3 KB/s, 94 ms old, 3 lost".into();
    diagram.stages[5].outputs[0].lost = true;
    diagram.stages[1].name = "a-name-that-is-longer-than-any-terminal-is-wide".repeat(4);
    for width in [20, 40, 80, 200] {
        let said = text(&diagram, Terminal { width, colour: false });
        let longest = said.lines().map(|line| line.chars().count()).max();
        assert!(width < 80 || longest <= Some(width), "{said}");
        assert!(!said.contains('\u{1b}'));
    }
    let said = text(
        &diagram,
        Terminal {
            width: 80,
            colour: false,
        },
    );
    for expected in [
        "╭ detected",
        "│ ╭ inner",
        "▸ clouds   Boxes        → others.detected.encoder/clouds",
        "◂ clouds   player/clouds",
        "◂ heard    v2x.link/back (back)",
        "▸ truth    Boxes        → score.results/truth",
        "20.0 Hz, boxes 109.3 KB/s, 94 ms old, 3 lost",
    ] {
        assert!(said.contains(expected), "no `{expected}` in\n{said}");
    }
    assert!(said.contains("│ player │") && said.contains("│ v2x │"), "{said}");
    let coloured = text(
        &diagram,
        Terminal {
            width: 80,
            colour: true,
        },
    );
    assert!(coloured.contains("\u{1b}[1m"));
}

#[test]
fn processes_flow_to_each_other_in_a_terminal() {
    let flow = overview::overview(&small(), 80);
    let expected = "\
╭────────╮                             ╭───────╮
│ player │─┬────────────────────────┬─▸│ score │
╰────────╯ │╭───────────────────────┤  ╰───────╯
           ││  ╭────────╮   ╭─────╮ │
           ╰┴─▸│ others │──▸│ v2x │─╯
               ╰────────╯   ╰─────╯
";
    assert_eq!(flow, expected, "\n{flow}");
    assert_eq!(overview::overview(&small(), 30), "", "it does not fit");
}

/// Graphs of any kind, most of them nonsense.
fn nonsense() -> impl Strategy<Value = Diagram> {
    let stages = prop::collection::vec((0..5_usize, 0..3_usize, 0..3_usize), 1..14);
    let wires = prop::collection::vec((0..14_usize, 0..14_usize, any::<bool>()), 0..30);
    let groups = prop::collection::vec(0..5_usize, 5);
    (stages, wires, groups).prop_map(|(stages, wires, groups)| {
        let mut diagram = Diagram {
            title: "any".into(),
            processes: processes(&["a", "b", "c", "d", "e"]),
            ..Diagram::default()
        };
        let names = ["one", "two", "three"].map(String::from);
        diagram.groups = names
            .map(|name| Group {
                name,
                ..Group::default()
            })
            .to_vec();
        for (process, group) in diagram.processes.iter_mut().zip(groups) {
            process.group = Some(group).filter(|group| *group < 3);
        }
        for (at, (process, module, depth)) in stages.into_iter().enumerate() {
            let mut stage = stage(process, &format!("stage{at}"), &[], &[]);
            stage.modules = (0..depth).map(|level| format!("m{module}{level}")).collect();
            diagram.stages.push(stage);
        }
        let count = diagram.stages.len();
        for (from, to, feedback) in wires {
            let [from, to] = [from % count, to % count];
            let (output, input) = (diagram.stages[from].outputs.len(), diagram.stages[to].inputs.len());
            if output == 0 || output % 2 == 1 {
                diagram.stages[from]
                    .outputs
                    .push(port(&format!("out{output}"), "Packet"));
            }
            let output = diagram.stages[from].outputs.len() - 1;
            diagram.stages[to].inputs.push(port(&format!("in{input}"), ""));
            diagram.wires.push(Wire {
                feedback,
                ..wire([from, output], [to, input])
            });
        }
        diagram
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]
    #[test]
    fn every_graph_can_be_drawn(diagram in nonsense()) {
        check(&diagram);
        for width in [1, 80, 300] {
            let said = text(&diagram, Terminal { width, colour: false });
            let named = diagram.stages.iter().all(|stage| said.contains(&stage.name));
            prop_assert!(named);
        }
    }
}
