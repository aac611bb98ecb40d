//! A headless Chromium, driven by its DevTools protocol over pipes: for tests and benches of pages. It draws with the processor
//! alone, so that no graphics card is needed.

use std::io::{self, BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

/// Names under which systems install it.
const NAMES: [&str; 4] = ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];
/// From one look at the page to the next.
const LOOK: Duration = Duration::from_millis(20);
/// A browser that is asked to close and does not for so long is ended.
const TO_CLOSE: Duration = Duration::from_secs(5);

/// What to do where there is none.
pub const HINT: &str = "install chromium, for example by `apt-get install chromium`";

/// Why a page could not be looked at.
#[derive(Debug, thiserror::Error)]
pub enum BrowserError {
    /// The browser cannot be started.
    #[error("{}: {reason}", program.display())]
    Start {
        /// The browser.
        program: PathBuf,
        /// What the system says.
        reason: io::Error,
    },
    /// It ended, or says what no browser does.
    #[error("the browser ended at {0}")]
    Ended(String),
    /// It refuses a call, or the page's script failed.
    #[error("{at}: {reason}")]
    Refused {
        /// The method, or the expression.
        at: String,
        /// What the browser says.
        reason: String,
    },
    /// A wish that did not come true in time.
    #[error("not true after {:.0} s: {expression}", after.as_secs_f64())]
    Late {
        /// The wish.
        expression: String,
        /// The time.
        after: Duration,
    },
}

/// A browser with one page.
pub struct Browser {
    process: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    session: Option<String>,
    calls: u64,
    /// Errors and messages of the page's console.
    pub said: Vec<String>,
}

/// How a page is looked at.
#[derive(Clone, Copy, Debug)]
pub struct Screen {
    /// Width and height, px; narrow ones are those of phones.
    pub size: [u32; 2],
    /// Whether the system's colours are dark; `None` leaves them.
    pub dark: Option<bool>,
}

/// The browser that is installed, if one is.
pub fn installed() -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let folders: Vec<PathBuf> = std::env::split_paths(&path).collect();
    let files = NAMES
        .iter()
        .flat_map(|name| folders.iter().map(move |folder| folder.join(name)));
    files.into_iter().find(|file| file.is_file())
}

impl Browser {
    /// Starts one with an own profile in a folder.
    ///
    /// # Errors
    /// A browser that cannot be started, or does not answer.
    pub fn start(program: &Path, profile: &Path) -> Result<Self, BrowserError> {
        let failed = |reason: io::Error| BrowserError::Start {
            program: program.into(),
            reason,
        };
        // The protocol is spoken over the descriptors 3 and 4.
        let mut process = Command::new("sh")
            .args(["-c", r#"exec "$0" "$@" 3<&0 4>&1"#])
            .arg(program)
            .args([
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--no-first-run",
                "--disable-dev-shm-usage",
            ])
            .args(["--remote-debugging-pipe", "about:blank"])
            .arg(format!("--user-data-dir={}", profile.display()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(failed)?;
        let (Some(input), Some(output)) = (process.stdin.take(), process.stdout.take()) else {
            return Err(failed(io::ErrorKind::BrokenPipe.into()));
        };
        let mut browser = Browser {
            process,
            input,
            output: BufReader::new(output),
            session: None,
            calls: 0,
            said: Vec::new(),
        };
        let target = browser.call("Target.createTarget", json!({"url": "about:blank"}))?;
        let attach = json!({"targetId": target["targetId"], "flatten": true});
        let session = browser.call("Target.attachToTarget", attach)?;
        browser.session = session["sessionId"].as_str().map(Into::into);
        for domain in ["Page", "Runtime", "Log"] {
            browser.call(&format!("{domain}.enable"), json!({}))?;
        }
        Ok(browser)
    }

    /// Calls a method of the protocol.
    ///
    /// # Errors
    /// A browser that ended, or refuses the call.
    pub fn call(&mut self, method: &str, params: Value) -> Result<Value, BrowserError> {
        let ended = || BrowserError::Ended(method.into());
        self.calls += 1;
        let mut message = json!({"id": self.calls, "method": method, "params": params});
        if let Some(session) = &self.session {
            message["sessionId"] = json!(session);
        }
        self.input
            .write_all(format!("{message}\0").as_bytes())
            .map_err(|_| ended())?;
        loop {
            let mut bytes = Vec::new();
            self.output.read_until(0, &mut bytes).map_err(|_| ended())?;
            if bytes.pop() != Some(0) {
                return Err(ended());
            }
            let answer: Value = serde_json::from_slice(&bytes).map_err(|_| ended())?;
            if answer["id"] == self.calls {
                return match &answer["error"] {
                    Value::Null => Ok(answer["result"].clone()),
                    error => Err(refused(method, error)),
                };
            }
            let event = answer["method"].as_str().unwrap_or_default();
            if ["Runtime.exceptionThrown", "Runtime.consoleAPICalled", "Log.entryAdded"].contains(&event) {
                self.said.push(answer["params"].to_string());
            }
        }
    }

    /// Goes to an address, as `file:///report.html#sweep=3`, and waits so long at most until its page is there.
    ///
    /// # Errors
    /// A browser that ended, and a page that does not come.
    pub fn go(&mut self, url: &str, screen: Screen, patience: Duration) -> Result<(), BrowserError> {
        let [width, height] = screen.size;
        let size = json!({"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600});
        self.call("Emulation.setDeviceMetricsOverride", size)?;
        if let Some(dark) = screen.dark {
            let scheme = if dark { "dark" } else { "light" };
            let media = json!({"features": [{"name": "prefers-color-scheme", "value": scheme}]});
            self.call("Emulation.setEmulatedMedia", media)?;
        }
        self.call("Page.navigate", json!({"url": "about:blank"}))?;
        self.call("Page.navigate", json!({"url": url}))?;
        let loaded = "location.href !== 'about:blank' && document.readyState === 'complete'";
        self.wait(loaded, patience)
    }

    /// The value of an expression on the page.
    ///
    /// # Errors
    /// A browser that ended, and an expression that fails.
    pub fn value(&mut self, expression: &str) -> Result<Value, BrowserError> {
        let params = json!({"expression": expression, "returnByValue": true, "awaitPromise": true});
        let answer = self.call("Runtime.evaluate", params)?;
        match &answer["exceptionDetails"] {
            Value::Null => Ok(answer["result"]["value"].clone()),
            thrown => Err(refused(expression, thrown)),
        }
    }

    /// Waits so long at most until an expression is true.
    ///
    /// # Errors
    /// A browser that ended, and an expression that fails or does not come true.
    pub fn wait(&mut self, expression: &str, patience: Duration) -> Result<(), BrowserError> {
        let start = Instant::now();
        while self.value(expression)? != true {
            if start.elapsed() > patience {
                return Err(BrowserError::Late {
                    expression: expression.into(),
                    after: patience,
                });
            }
            std::thread::sleep(LOOK);
        }
        Ok(())
    }

    /// Presses and releases a key.
    ///
    /// # Errors
    /// A browser that ended.
    pub fn press(&mut self, key: &str) -> Result<(), BrowserError> {
        for kind in ["keyDown", "keyUp"] {
            let mut params = json!({"type": kind, "key": key});
            if key.len() == 1 && kind == "keyDown" {
                params["text"] = json!(key);
            }
            self.call("Input.dispatchKeyEvent", params)?;
        }
        Ok(())
    }

    /// A picture of what is on the screen, PNG in base64.
    ///
    /// # Errors
    /// A browser that ended.
    pub fn picture(&mut self) -> Result<String, BrowserError> {
        let picture = self.call("Page.captureScreenshot", json!({"format": "png"}))?;
        Ok(picture["data"].as_str().unwrap_or_default().into())
    }
}

fn refused(at: &str, reason: &Value) -> BrowserError {
    BrowserError::Refused {
        at: at.into(),
        reason: reason.to_string(),
    }
}

impl Drop for Browser {
    fn drop(&mut self) {
        let close = json!({"id": 0, "method": "Browser.close"});
        let _ = self.input.write_all(format!("{close}\0").as_bytes());
        let start = Instant::now();
        while matches!(self.process.try_wait(), Ok(None)) && start.elapsed() < TO_CLOSE {
            std::thread::sleep(LOOK);
        }
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}
