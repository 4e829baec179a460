//! Values that clap does not know: sizes, shares, ranges, pixels, times.

use std::time::Duration;

use crate::network::is_device;

/// A number from 0 to 1.
pub fn share(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if (0.0..=1.0).contains(&value) { Ok(value) } else { Err(format!("{text} is not from 0 to 1")) }
}

/// A positive, finite number.
pub fn positive(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err(format!("{text} is not positive")) }
}

/// A positive, finite length in 64 bits: thresholds are compared with distances of that precision.
pub fn length(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err(format!("{text} is not positive")) }
}

/// Two depths, `NEAR,FAR`.
pub fn depth_range(text: &str) -> Result<(f64, f64), String> {
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| format!("{text} is not a number"));
    let (near, far) = text.split_once(',').ok_or("two depths are needed: NEAR,FAR")?;
    let (near, far) = (number(near)?, number(far)?);
    if near > 0.0 && far > near && far.is_finite() {
        Ok((near, far))
    } else {
        Err(format!("{near} to {far} is not positive and increasing"))
    }
}

/// A size in bytes: a number with K, M, G or T (powers of 1024) behind it or without.
pub fn bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let shift = match text[digits.len()..].trim_end_matches(['B', 'b', 'i']).to_ascii_uppercase().as_str() {
        "" => 0,
        "K" => 10,
        "M" => 20,
        "G" => 30,
        "T" => 40,
        _ => return Err(format!("{text} is no size; write it like 800M or 2G")),
    };
    let number: f64 = digits.parse().map_err(|_| format!("{text} is no size; write it like 800M or 2G"))?;
    let size = number * (1_u64 << shift) as f64;
    if (1.0..1e18).contains(&size) { Ok(size as u64) } else { Err(format!("{text} is no size")) }
}

/// A positive number of seconds.
pub fn seconds(text: &str) -> Result<Duration, String> {
    let value: f64 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    let duration =
        Duration::try_from_secs_f64(value).map_err(|_| format!("{text} is no number of seconds"))?;
    if duration.is_zero() { Err(format!("{text} is not positive")) } else { Ok(duration) }
}

/// Where to infer.
pub fn device(text: &str) -> Result<String, String> {
    if is_device(text) {
        Ok(text.to_owned())
    } else {
        Err("it is none of cpu, torch, cuda and cuda:N".to_owned())
    }
}

/// Addresses of a coordinator, with commas between.
pub fn coordinator(text: &str) -> Result<String, String> {
    let is_address = |address: &str| {
        let host = address.trim().strip_prefix("http://").or_else(|| address.trim().strip_prefix("https://"));
        host.is_some_and(|host| !host.is_empty() && !host.starts_with([':', '/']))
    };
    if text.split(',').all(is_address) {
        Ok(text.to_owned())
    } else {
        Err("an address is like http://10.0.0.1:7070 or https://head:7070".to_owned())
    }
}

/// A pixel, column and row, as "X,Y".
pub fn pixel(text: &str) -> Result<(usize, usize), String> {
    let number = |text: &str| text.trim().parse().ok();
    let pixel = text.split_once(',').and_then(|(x, y)| Some((number(x)?, number(y)?)));
    pixel.ok_or_else(|| "a pixel is two numbers with a comma between, such as 12,34".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_have_units() {
        assert_eq!(bytes("1.5G"), Ok(3 << 29));
        assert_eq!(bytes("800MiB"), Ok(800 << 20));
        assert!(bytes("2X").is_err() && bytes("-1G").is_err());
    }

    #[test]
    fn devices_and_coordinators_have_a_form() {
        for right in ["cpu", "torch", "cuda", "cuda:1"] {
            assert_eq!(device(right).as_deref(), Ok(right));
        }
        for wrong in ["gpu", "cuda:", "cuda:x", ""] {
            assert!(device(wrong).is_err(), "{wrong}");
        }
        for right in ["http://head:7070", "https://a:1,https://b:2"] {
            assert_eq!(coordinator(right).as_deref(), Ok(right));
        }
        for wrong in ["foo", "head:7070", "http://", "http://:7070", "http://a:1,b"] {
            assert!(coordinator(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn a_pixel_is_two_numbers() {
        assert_eq!(pixel("12,34"), Ok((12, 34)));
        for wrong in ["12", "12,", "1,2,3", "-1,2"] {
            assert!(pixel(wrong).is_err(), "{wrong}");
        }
    }
}
