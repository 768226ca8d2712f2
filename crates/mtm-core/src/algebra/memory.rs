//! An allocator that requests huge pages for large buffers.
//!
//! Factorisations, tensors and multigrid levels take hundreds of megabytes that are written once and then
//! streamed. With pages of 4 KiB the first access to that memory cost more than the arithmetic on it: the
//! numeric factorisation of 300 000 tets took three times as long. If transparent huge pages are set to
//! `madvise` (Debian, Ubuntu) or `always`, one call per buffer avoids this; elsewhere it has no effect.
//!
//! A page that the kernel clears for the first time can cost ten times as much as one in use, above all in a
//! virtual machine. Up to [`KEPT_BYTES`] of freed buffers are therefore kept for the next requests: the set-up of a
//! multigrid hierarchy frees a third of what it allocates.

#[cfg(target_os = "linux")]
use kept::{Buffer, LIVE, Relaxed, is_large, keep, map, rounded, take_kept, taken};
use std::alloc::{GlobalAlloc, Layout, System};

/// Freed buffers that are kept at most, bytes; or [`KEPT_SHARE`] of the large buffers in use, if that is more.
pub const KEPT_BYTES: usize = 64 << 20;
/// See [`KEPT_BYTES`]: Newton's method frees and requests hundreds of megabytes in every step.
pub const KEPT_SHARE: f64 = 0.25;

/// The system's allocator, with huge pages for large buffers on Linux.
///
/// A binary opts in: `#[global_allocator] static MEMORY: HugePages = HugePages;`
pub struct HugePages;

// SAFETY: small requests are passed to the system allocator. Large ones are private anonymous mappings of the
// requested size in whole huge pages, aligned to a huge page (more than any layout requests below that). Their
// length follows from the layout, so that they are kept or unmapped as a whole.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for HugePages {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            let length = rounded(layout.size());
            return taken(take_kept(length).unwrap_or_else(|| unsafe { map(length) }), length);
        }
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            let length = rounded(layout.size());
            if let Some(pointer) = take_kept(length) {
                // SAFETY: the buffer has this length, and is nobody else's.
                unsafe { pointer.write_bytes(0, layout.size()) };
                return taken(pointer, length);
            }
            // The kernel clears new pages.
            return taken(unsafe { map(length) }, length);
        }
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            let length = rounded(layout.size());
            LIVE.fetch_sub(length, Relaxed);
            keep(Buffer { start: pointer, length });
            return;
        }
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        #[cfg(target_os = "linux")]
        {
            // SAFETY: the caller promises that `size`, rounded up to the alignment, is a valid size.
            let new = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
            if is_large(layout) || is_large(new) {
                let moved = unsafe { self.alloc(new) };
                if !moved.is_null() {
                    // SAFETY: both blocks are live, distinct and at least this long.
                    unsafe {
                        std::ptr::copy_nonoverlapping(pointer, moved, layout.size().min(size));
                        self.dealloc(pointer, layout);
                    }
                }
                return moved;
            }
        }
        unsafe { System.realloc(pointer, layout, size) }
    }
}

/// Large buffers: where they come from, and those that are kept.
#[cfg(target_os = "linux")]
mod kept {
    use std::alloc::Layout;
    use std::sync::Mutex;
    use std::sync::atomic::AtomicUsize;
    pub(super) use std::sync::atomic::Ordering::Relaxed;

    use super::{KEPT_BYTES, KEPT_SHARE};

    /// Size of a huge page on x86-64 and most arm64 systems, bytes.
    const HUGE_PAGE: usize = 2 << 20;
    /// Buffers of at least this size get their own pages, bytes.
    const LARGE: usize = HUGE_PAGE;
    /// Number of freed buffers that are kept at most.
    const KEPT_COUNT: usize = 16;

    pub(super) fn is_large(layout: Layout) -> bool {
        layout.size() >= LARGE && layout.align() <= HUGE_PAGE
    }

    /// `size` in whole huge pages.
    pub(super) fn rounded(size: usize) -> usize {
        size.div_ceil(HUGE_PAGE) * HUGE_PAGE
    }

    /// A freed buffer in whole huge pages.
    #[derive(Clone, Copy)]
    pub(super) struct Buffer {
        pub start: *mut u8,
        pub length: usize,
    }

    // SAFETY: a freed buffer belongs to whoever holds it.
    #[allow(unsafe_code)]
    unsafe impl Send for Buffer {}

    impl Buffer {
        const NONE: Self = Self { start: std::ptr::null_mut(), length: 0 };

        /// Returns the pages from `offset` on to the system.
        #[allow(unsafe_code)]
        fn unmap_from(self, offset: usize) {
            if offset < self.length {
                // SAFETY: the pages belong to this buffer, which is freed.
                unsafe { libc::munmap(self.start.add(offset).cast(), self.length - offset) };
            }
        }
    }

    /// Large buffers in use, bytes.
    pub(super) static LIVE: AtomicUsize = AtomicUsize::new(0);

    /// `pointer`, whose `length` bytes are in use unless it is null.
    pub(super) fn taken(pointer: *mut u8, length: usize) -> *mut u8 {
        if !pointer.is_null() {
            LIVE.fetch_add(length, Relaxed);
        }
        pointer
    }

    /// Freed buffers that are kept now at most, bytes.
    fn most_kept() -> usize {
        KEPT_BYTES.max((KEPT_SHARE * LIVE.load(Relaxed) as f64) as usize)
    }

    /// The kept buffers, the oldest first; places without one have length 0.
    static KEPT: Mutex<[Buffer; KEPT_COUNT]> = Mutex::new([Buffer::NONE; KEPT_COUNT]);

    /// What `work` makes of the kept buffers; none while another thread uses them.
    fn with_kept<T>(work: impl FnOnce(&mut [Buffer; KEPT_COUNT]) -> T) -> Option<T> {
        KEPT.try_lock().ok().map(|mut kept| work(&mut kept))
    }

    /// The smallest kept buffer of at least `length` bytes, cut to that length.
    pub(super) fn take_kept(length: usize) -> Option<*mut u8> {
        let found = with_kept(|kept| {
            let fits = |b: &(usize, &Buffer)| b.1.length >= length;
            let (place, _) = kept.iter().enumerate().filter(fits).min_by_key(|b| b.1.length)?;
            let found = kept[place];
            kept[place..].rotate_left(1);
            kept[KEPT_COUNT - 1] = Buffer::NONE;
            Some(found)
        });
        let found = found.flatten()?;
        found.unmap_from(length);
        Some(found.start)
    }

    /// Keeps `freed` for a later request, and returns what is then too much to the system.
    pub(super) fn keep(freed: Buffer) {
        let most = most_kept();
        if freed.length > most {
            return freed.unmap_from(0);
        }
        let kept = with_kept(|kept| {
            let mut excess = freed.length + kept.iter().map(|b| b.length).sum::<usize>();
            // The first place is freed at least.
            let full = kept[KEPT_COUNT - 1].length > 0;
            let mut dropped = 0;
            while excess > most || (full && dropped == 0) {
                excess -= kept[dropped].length;
                kept[dropped].unmap_from(0);
                kept[dropped] = Buffer::NONE;
                dropped += 1;
            }
            kept.rotate_left(dropped);
            let free = kept.iter().position(|b| b.length == 0).unwrap_or(KEPT_COUNT - 1);
            kept[free] = freed;
        });
        if kept.is_none() {
            freed.unmap_from(0);
        }
    }

    /// A zeroed mapping of `length` bytes, whole huge pages, or null.
    #[allow(unsafe_code)]
    pub(super) unsafe fn map(length: usize) -> *mut u8 {
        let Some(reserved) = length.checked_add(HUGE_PAGE) else { return std::ptr::null_mut() };
        // SAFETY: an anonymous mapping at an address chosen by the kernel, one huge page longer than needed, so
        // that it contains an aligned run of the length; the parts before and after that run are given back.
        unsafe {
            let base = libc::mmap(
                std::ptr::null_mut(),
                reserved,
                libc::PROT_READ | libc::PROT_WRITE,
                libc::MAP_PRIVATE | libc::MAP_ANONYMOUS,
                -1,
                0,
            );
            if base == libc::MAP_FAILED {
                return std::ptr::null_mut();
            }
            let base: *mut u8 = base.cast();
            let before = base.align_offset(HUGE_PAGE);
            let pointer = base.add(before);
            if before > 0 {
                libc::munmap(base.cast(), before);
            }
            let after = reserved - before - length;
            if after > 0 {
                libc::munmap(pointer.add(length).cast(), after);
            }
            // If the kernel refuses, ordinary pages are used, which are only slower.
            libc::madvise(pointer.cast(), length, libc::MADV_HUGEPAGE);
            pointer
        }
    }

    #[cfg(test)]
    mod tests {
        use super::*;
        use crate::algebra::memory::HugePages;
        use std::alloc::GlobalAlloc;

        const MB: usize = 1 << 20;

        fn layout(size: usize) -> Layout {
            Layout::from_size_align(size, 8).expect("a valid layout")
        }

        /// Other tests of this process use the system's allocator, so that the kept buffers are those of this one.
        #[test]
        #[allow(unsafe_code)]
        fn freed_buffers_are_used_again_and_cleared() {
            let total = || {
                with_kept(|kept| kept.iter().map(|b| b.length).sum::<usize>())
                    .expect("no other user")
            };
            unsafe {
                let first = HugePages.alloc(layout(9 * MB));
                first.write_bytes(7, 9 * MB);
                HugePages.dealloc(first, layout(9 * MB));
                assert_eq!(total(), 10 * MB);
                let second = HugePages.alloc_zeroed(layout(5 * MB));
                assert_eq!(second, first);
                assert_eq!(total(), 0, "the rest is returned");
                assert!(std::slice::from_raw_parts(second, 5 * MB).iter().all(|&byte| byte == 0));
                HugePages.dealloc(second, layout(5 * MB));

                // Neither more bytes nor more buffers than the limits; the newest stay.
                let many: Vec<_> =
                    (0..3 * KEPT_COUNT).map(|_| HugePages.alloc(layout(8 * MB))).collect();
                for &buffer in &many {
                    buffer.write_bytes(1, 8 * MB);
                    HugePages.dealloc(buffer, layout(8 * MB));
                    assert!(total() <= most_kept());
                }
                assert_eq!(total(), KEPT_BYTES);
                let again = HugePages.alloc(layout(8 * MB));
                assert!(many[many.len() - 8..].contains(&again));
                HugePages.dealloc(again, layout(8 * MB));
                let small: Vec<_> =
                    (0..3 * KEPT_COUNT).map(|_| HugePages.alloc(layout(2 * MB))).collect();
                for buffer in small {
                    HugePages.dealloc(buffer, layout(2 * MB));
                }
                assert_eq!(total(), 2 * MB * KEPT_COUNT);

                let large = HugePages.alloc(layout(KEPT_BYTES + 1));
                HugePages.dealloc(large, layout(KEPT_BYTES + 1));
                assert_eq!(total(), 2 * MB * KEPT_COUNT);

                // A share of what is in use.
                let used = HugePages.alloc(layout(8 * KEPT_BYTES));
                let large = HugePages.alloc(layout(2 * KEPT_BYTES));
                HugePages.dealloc(large, layout(2 * KEPT_BYTES));
                assert_eq!(HugePages.alloc(layout(2 * KEPT_BYTES)), large);
                HugePages.dealloc(large, layout(2 * KEPT_BYTES));
                HugePages.dealloc(used, layout(8 * KEPT_BYTES));
                HugePages.dealloc(HugePages.alloc(layout(2 * MB)), layout(2 * MB));
                assert!(total() <= KEPT_BYTES);
            }
        }
    }
}
