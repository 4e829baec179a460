//! What the kernel says of this host.

/// Its name.
pub fn name() -> String {
    read("/proc/sys/kernel/hostname").unwrap_or_else(|| "localhost".to_owned())
}

/// What tells two hosts of one name apart, and a host before and after its restart; empty where nothing does.
pub fn boot_id() -> String {
    read("/proc/sys/kernel/random/boot_id").unwrap_or_default()
}

/// A text that nobody else has.
pub fn unique() -> Option<String> {
    read("/proc/sys/kernel/random/uuid")
}

fn read(path: &str) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}
