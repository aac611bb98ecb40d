//! The page around the document.

use realo_render::escaped as as_html;

const PAGE: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
const TOOLS: &str = include_str!("page/tools.js");
const PLAYER: &str = include_str!("page/player.js");
const LIVE: &str = include_str!("page/live.js");
const SCRIPTS: [&str; 4] = [
    TOOLS,
    PLAYER,
    include_str!("page/charts.js"),
    include_str!("page/report.js"),
];

/// The page: `json` is a JSON document, `points` texts of base64 without any other letter.
///
/// Names of others come into the page as text alone: a `<` of the document is written as its escape, so that it ends no
/// element; the title is escaped for HTML.
pub fn html(title: &str, json: &str, points: &str) -> String {
    filled([
        ("title", as_html(title)),
        ("what", "report".into()),
        ("contact", String::new()),
        ("style", STYLE.into()),
        ("data", escaped(json)),
        ("points", points.into()),
        ("scripts", SCRIPTS.join("\n")),
    ])
}

/// The page of a run that goes on. `host`: name or number, and port, of the server that it comes from and asks for pictures; nothing
/// else can be asked.
pub fn live_html(host: &str, json: &str) -> String {
    filled([
        ("title", "live".into()),
        ("what", "view".into()),
        ("contact", format!("; connect-src ws://{}", as_html(host))),
        ("style", STYLE.into()),
        ("data", escaped(json)),
        ("points", String::new()),
        ("scripts", [TOOLS, PLAYER, LIVE].join("\n")),
    ])
}

/// JSON as it stands in a page: nothing in it ends an element.
pub fn escaped(json: &str) -> String {
    json.replace('<', "\\u003c")
}

fn filled(parts: [(&str, String); 7]) -> String {
    let length: usize = parts.iter().map(|(_, text)| text.len()).sum();
    let mut page = String::with_capacity(PAGE.len() + length);
    let mut rest = PAGE;
    // In one pass, so that nothing that is put in is looked at again.
    while let Some((before, after)) = rest.split_once("{{") {
        page.push_str(before);
        let (name, after) = after.split_once("}}").unwrap_or((after, ""));
        let part = parts.iter().find(|(known, _)| *known == name);
        page.push_str(part.map_or("", |(_, text)| text));
        rest = after;
    }
    page.push_str(rest);
    page
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_cannot_leave_their_place() {
        let name = "</script><script>alert('1')</script>\"{{data}}";
        let json = serde_json::json!({ "name": name }).to_string();
        let page = html(name, &json, "");
        assert_eq!(page.matches("alert(").count(), 2, "in the title and in the data");
        assert!(!page.contains("<script>alert"));
        let data = page
            .split_once("<script type=\"application/json\" id=\"data\">")
            .unwrap()
            .1;
        let data = data.split_once("</script>").unwrap().0;
        let read: serde_json::Value = serde_json::from_str(data).unwrap();
        assert_eq!(read["name"], name);
    }

    #[test]
    fn the_page_asks_no_network() {
        let page = html("a", "{}", "");
        assert!(page.contains("default-src 'none'"));
        for outside in [
            "src=\"http",
            "href=\"http",
            "@import",
            "url(http",
            "fetch(",
            "XMLHttpRequest",
        ] {
            assert!(!page.contains(outside), "{outside}");
        }
        assert!(
            [&SCRIPTS[..], &[LIVE]]
                .concat()
                .iter()
                .all(|script| !script.contains("</script") && !script.contains("<!--"))
        );
    }
}
