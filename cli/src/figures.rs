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

/// A share from 0 to 1: `37 %`.
pub fn percent(share: f64) -> String {
    format!("{:.0} %", 100.0 * share)
}

/// Milliseconds since 1970 as a time of day in UTC: `2026-11-27 21:10:04`.
pub fn time(milliseconds: i64) -> String {
    let seconds = milliseconds.div_euclid(1_000);
    let (day, second) = (seconds.div_euclid(86_400), seconds.rem_euclid(86_400));
    // Days since 1 March of the year 0, whose leap day is the last one: Howard Hinnant's `civil_from_days`
    let shifted = day + 719_468;
    let (era, of_era) = (shifted.div_euclid(146_097), shifted.rem_euclid(146_097));
    let year = (of_era - of_era / 1_460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year + year / 4 - year / 100);
    let month = (5 * of_year + 2) / 153;
    let date = of_year - (153 * month + 2) / 5 + 1;
    let (month, is_next) = if month < 10 { (month + 3, 0) } else { (month - 9, 1) };
    let (hour, minute) = (second / 3_600, second / 60 % 60);
    format!("{:04}-{month:02}-{date:02} {hour:02}:{minute:02}:{:02}", 400 * era + year + is_next, second % 60)
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
        assert_eq!(percent(0.374), "37 %");
    }

    /// Catches a day that is off by one around leap days and turns of the year.
    #[test]
    fn times_are_the_calendars() {
        for (milliseconds, text) in [
            (0, "1970-01-01 00:00:00"),
            (951_782_400_000, "2000-02-29 00:00:00"),
            (951_868_799_999, "2000-02-29 23:59:59"),
            (1_709_251_200_000, "2024-03-01 00:00:00"),
            (1_767_225_599_000, "2025-12-31 23:59:59"),
            (-1, "1969-12-31 23:59:59"),
        ] {
            assert_eq!(time(milliseconds), text);
        }
    }
}
