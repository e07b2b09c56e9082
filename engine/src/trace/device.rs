//! What traces: the name that `--device` takes.

use std::fmt;
use std::str::FromStr;

/// What is to trace.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Device {
    /// The best real GPU; the CPU where there is none.
    Auto,
    /// The CPU.
    #[default]
    Cpu,
    /// A real GPU: the best one, or the one of this number in the list of devices.
    Gpu(Option<u16>),
    /// A software adapter: slow, for tests.
    Software,
    /// All real GPUs, which share every batch.
    All,
}

impl FromStr for Device {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "cpu" => Ok(Self::Cpu),
            "gpu" => Ok(Self::Gpu(None)),
            "software" => Ok(Self::Software),
            "all" => Ok(Self::All),
            _ => text
                .strip_prefix("gpu:")
                .and_then(|number| number.parse().ok())
                .map(|number| Self::Gpu(Some(number)))
                .ok_or_else(|| "expected one of: auto, cpu, gpu, gpu:N, software, all".into()),
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu(None) => f.write_str("gpu"),
            Self::Gpu(Some(number)) => write!(f, "gpu:{number}"),
            Self::Software => f.write_str("software"),
            Self::All => f.write_str("all"),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches a device of the grammar that is read as another one or not at all.
    #[test]
    fn devices_parse_and_print() {
        for name in ["auto", "cpu", "gpu", "gpu:1", "software", "all"] {
            assert_eq!(name.parse::<Device>().unwrap().to_string(), name);
        }
        for name in ["", "gpu:", "gpu:x", "gpu:70000", "GPU"] {
            assert!(name.parse::<Device>().is_err(), "{name}");
        }
    }
}
