//! A headless Chromium whose every failure fails the test.
#![allow(dead_code)]

use std::ops::Deref;
use std::path::Path;
use std::time::Duration;

use realo_browser::{HINT, Screen, installed};
use serde_json::Value;

/// A page longer in loading, or a wish longer without its coming true, fails the test.
const PATIENCE: Duration = Duration::from_secs(60);

/// A browser with one page.
pub struct Browser(realo_browser::Browser);

impl Browser {
    /// Starts one with an own profile in a folder; where none is installed, the running test is left out.
    pub fn start(profile: &Path) -> Option<Self> {
        let Some(program) = installed() else {
            skipped::skip(HINT);
            return None;
        };
        let browser = realo_browser::Browser::start(&program, profile);
        Some(Browser(browser.expect("the browser starts")))
    }

    /// Calls a method of the protocol.
    pub fn call(&mut self, method: &str, params: Value) -> Value {
        said(self.0.call(method, params))
    }

    /// Opens a file on a screen of this size, and waits until it is drawn.
    pub fn open(&mut self, file: &Path, hash: &str, size: [u32; 2], dark: bool) {
        let screen = Screen { size, dark: Some(dark) };
        said(self.0.go(&format!("file://{}{hash}", file.display()), screen, PATIENCE));
    }

    /// Opens an address on a screen of this size, and waits until its page is there.
    pub fn visit(&mut self, url: &str, size: [u32; 2]) {
        said(self.0.go(url, Screen { size, dark: None }, PATIENCE));
    }

    /// The value of an expression on the page.
    pub fn value(&mut self, expression: &str) -> Value {
        said(self.0.value(expression))
    }

    /// Waits until an expression is true.
    pub fn wait(&mut self, expression: &str) {
        said(self.0.wait(expression, PATIENCE));
    }

    /// Presses and releases a key.
    pub fn press(&mut self, key: &str) {
        said(self.0.press(key));
    }

    /// A picture of what is on the screen, PNG in base64.
    pub fn picture(&mut self) -> String {
        said(self.0.picture())
    }
}

fn said<T>(result: Result<T, realo_browser::BrowserError>) -> T {
    result.unwrap_or_else(|error| panic!("{error}"))
}

impl Deref for Browser {
    type Target = realo_browser::Browser;

    fn deref(&self) -> &Self::Target {
        &self.0
    }
}
