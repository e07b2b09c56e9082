//! Numbers as people read them.

/// A count with its thousands apart: `10,000,000`.
pub fn count(value: u64) -> String {
    let digits = value.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (place, digit) in digits.chars().enumerate() {
        if place > 0 && (digits.len() - place).is_multiple_of(3) {
            text.push(',');
        }
        text.push(digit);
    }
    text
}

/// A large number to three digits: `10.1 M`.
pub fn short(value: f64) -> String {
    let (scaled, unit) = match value {
        v if v >= 1e9 => (v / 1e9, " G"),
        v if v >= 1e6 => (v / 1e6, " M"),
        v if v >= 1e4 => (v / 1e3, " k"),
        v => (v, ""),
    };
    format!("{scaled:.*}{unit}", if scaled >= 100.0 || unit.is_empty() { 0 } else { 1 })
}

/// Bytes in binary units: `1.5 GiB`.
pub fn bytes(value: u64) -> String {
    const UNITS: [&str; 5] = ["KiB", "MiB", "GiB", "TiB", "PiB"];
    if value < 1024 {
        return format!("{value} bytes");
    }
    let mut scaled = value as f64 / 1024.0;
    let mut unit = 0;
    while scaled >= 1023.95 && unit + 1 < UNITS.len() {
        scaled /= 1024.0;
        unit += 1;
    }
    format!("{scaled:.1} {}", UNITS[unit])
}

/// A time: `4.2 s`, `3 min 20 s`, `2 h 5 min`.
pub fn seconds(value: f64) -> String {
    if value < 59.95 {
        return format!("{value:.1} s");
    }
    let whole = value.round() as u64;
    match whole {
        0..3600 => format!("{} min {} s", whole / 60, whole % 60),
        _ => format!("{} h {} min", whole / 3600, whole / 60 % 60),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Catches commas in the wrong places and units that are off by a thousand.
    #[test]
    fn figures_read_well() {
        assert_eq!(
            ["1", "999", "1,000", "10,000,000"],
            [1, 999, 1000, 10_000_000].map(count).each_ref().map(|s| &**s)
        );
        assert_eq!(short(330_112.0), "330 k");
        assert_eq!(short(169_017_344.0), "169 M");
        assert_eq!(short(1_500.0), "1500");
        assert_eq!(bytes(1023), "1023 bytes");
        assert_eq!(bytes(3 << 29), "1.5 GiB");
        assert_eq!(bytes((1 << 30) - 1), "1.0 GiB");
        assert_eq!(seconds(59.99), "1 min 0 s");
        assert_eq!(seconds(4.21), "4.2 s");
        assert_eq!(seconds(7500.0), "2 h 5 min");
    }
}
