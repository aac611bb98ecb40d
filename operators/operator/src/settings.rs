use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::config::ConfigError;

/// One setting of an operator or node, as `realo operators` prints it. Its default is that of the settings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SettingInfo {
    /// Key in graphs and `--set`.
    pub name: &'static str,
    /// Meaning and unit, in a line.
    pub about: &'static str,
    /// The values that it takes, in words.
    pub range: Option<&'static str>,
    /// What it is to a tool that prepares runs: an open word, such as `model`, that the tool looks for.
    pub role: Option<&'static str>,
    /// Whether a value may be the path of a file or folder.
    pub is_path: bool,
}

impl SettingInfo {
    /// How many settings lists have.
    #[doc(hidden)]
    pub const fn count(lists: &[&[SettingInfo]]) -> usize {
        let (mut all, mut list) = (0, 0);
        while list < lists.len() {
            all += lists[list].len();
            list += 1;
        }
        all
    }

    /// The `N` settings of lists, in their order.
    #[doc(hidden)]
    pub const fn joined<const N: usize>(lists: &[&[SettingInfo]]) -> [SettingInfo; N] {
        let nothing = SettingInfo {
            name: "",
            about: "",
            range: None,
            role: None,
            is_path: false,
        };
        let (mut all, mut filled, mut list) = ([nothing; N], 0, 0);
        while list < lists.len() {
            let mut place = 0;
            while place < lists[list].len() {
                all[filled] = lists[list][place];
                filled += 1;
                place += 1;
            }
            list += 1;
        }
        all
    }
}

/// The settings of a stage; `#[derive(Settings)]` makes it from a documented struct.
///
/// ```
/// use realo_operator::config::parse;
/// use realo_operator::{Settings, StageSettings};
/// use serde::{Deserialize, Serialize};
///
/// #[derive(Debug, Settings, Serialize, Deserialize)]
/// struct Suppression {
///     /// IoU above which the box with the lower score is dropped.
///     #[setting(default = 0.15, range = 0.0..=1.0)]
///     threshold: f64,
/// }
///
/// assert_eq!(Suppression::SETTINGS[0].range, Some("0 to 1"));
/// assert_eq!(Suppression::default().threshold, 0.15);
/// let error = parse::<Suppression>(&["threshold=1.5".into()]).unwrap_err();
/// assert_eq!(error.to_string(), "setting `threshold`: expected 0 to 1, found 1.5");
/// ```
pub trait StageSettings: DeserializeOwned + Serialize + Default {
    /// Every key, in its order.
    const SETTINGS: &'static [SettingInfo];

    /// Whether every value lies in the range that its field declares.
    ///
    /// # Errors
    /// [`ConfigError::Range`] names the setting, the range and the value.
    fn check(&self) -> Result<(), ConfigError>;
}
