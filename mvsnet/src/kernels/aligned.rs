//! Memory for values, aligned to cache lines.
#![expect(unsafe_code, reason = "memory from the system is seen as values")]

use std::alloc::{Layout, handle_alloc_error};
use std::ptr::NonNull;

/// From this many bytes on, memory comes from the system and goes back to it: an allocator would keep it,
/// and peaks could not be predicted.
const SYSTEM_BYTES: usize = 256 << 10;
const ALIGNMENT: usize = 64;

/// Values aligned to cache lines, at first zero.
#[derive(Debug)]
pub(crate) struct Aligned {
    start: NonNull<f32>,
    len: usize,
}

// SAFETY: it owns its memory, as a vector does.
unsafe impl Send for Aligned {}
// SAFETY: shared, it can only be read.
unsafe impl Sync for Aligned {}

impl Aligned {
    pub(crate) fn zeroed(len: usize) -> Self {
        let layout = layout(len);
        let start = match layout.size() {
            0 => NonNull::dangling(),
            size if size < SYSTEM_BYTES => allocated(layout),
            _ => system::map(layout).unwrap_or_else(|| handle_alloc_error(layout)),
        };
        Self { start, len }
    }

    pub(crate) fn values(&self) -> &[f32] {
        // SAFETY: `start` points to `len` values, all of them initialised, for as long as `self` lives.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.len) }
    }

    pub(crate) fn values_mut(&mut self) -> &mut [f32] {
        // SAFETY: as above, and borrowed mutably.
        unsafe { std::slice::from_raw_parts_mut(self.start.as_ptr(), self.len) }
    }
}

impl Drop for Aligned {
    fn drop(&mut self) {
        let layout = layout(self.len);
        // SAFETY: the memory came from the same place with the same layout, and nobody borrows it any more.
        unsafe {
            match layout.size() {
                0 => {}
                size if size < SYSTEM_BYTES => std::alloc::dealloc(self.start.as_ptr().cast(), layout),
                _ => system::unmap(self.start, layout),
            }
        }
    }
}

fn layout(len: usize) -> Layout {
    let array = Layout::array::<f32>(len).and_then(|layout| layout.align_to(ALIGNMENT));
    array.expect("slabs of images fit into the address space")
}

fn allocated(layout: Layout) -> NonNull<f32> {
    // SAFETY: the layout is not empty.
    let start = unsafe { std::alloc::alloc_zeroed(layout) };
    NonNull::new(start.cast()).unwrap_or_else(|| handle_alloc_error(layout))
}

#[cfg(target_os = "linux")]
mod system {
    use std::alloc::Layout;
    use std::ptr::{NonNull, null_mut};

    /// Zeroed pages.
    pub(super) fn map(layout: Layout) -> Option<NonNull<f32>> {
        let (access, kind) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS);
        // SAFETY: a new private mapping touches no memory that exists. Pages are aligned to more than a line.
        let start = unsafe { libc::mmap(null_mut(), layout.size(), access, kind, -1, 0) };
        if start == libc::MAP_FAILED {
            return None;
        }
        // Large pages, where there are any, spare the processor thousands of faults; without them nothing changes.
        // SAFETY: the mapping is ours, and its content stays as it is.
        unsafe { libc::madvise(start, layout.size(), libc::MADV_HUGEPAGE) };
        NonNull::new(start.cast())
    }

    /// # Safety
    /// `start` came from `map` with this layout, and is used no more.
    pub(super) unsafe fn unmap(start: NonNull<f32>, layout: Layout) {
        // SAFETY: the mapping is ours alone, and it ends here. It cannot fail for a whole mapping.
        unsafe { libc::munmap(start.as_ptr().cast(), layout.size()) };
    }
}

#[cfg(not(target_os = "linux"))]
mod system {
    use std::alloc::Layout;
    use std::ptr::NonNull;

    pub(super) fn map(layout: Layout) -> Option<NonNull<f32>> {
        Some(super::allocated(layout))
    }

    /// # Safety
    /// `start` came from `map` with this layout, and is used no more.
    pub(super) unsafe fn unmap(start: NonNull<f32>, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { std::alloc::dealloc(start.as_ptr().cast(), layout) };
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn memory_is_zero_aligned_and_writable_wherever_it_comes_from() {
        for len in [0, 1, 1000, SYSTEM_BYTES / 4, 1_000_003] {
            let mut memory = Aligned::zeroed(len);
            assert!(memory.values().len() == len && memory.values().iter().all(|value| *value == 0.0));
            assert!(len == 0 || memory.values().as_ptr().addr().is_multiple_of(ALIGNMENT));
            memory.values_mut().fill(1.5);
            assert!(memory.values().iter().all(|value| *value == 1.5));
        }
    }
}
