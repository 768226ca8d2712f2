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
pub mod kept {
    use std::alloc::Layout;
    use std::sync::Mutex;
    use std::sync::atomic::AtomicUsize;
    pub(super) use std::sync::atomic::Ordering::Relaxed;

    pub use super::KEPT_BYTES;
    pub use super::KEPT_SHARE;

    /// Size of a huge page on x86-64 and most arm64 systems, bytes.
    const HUGE_PAGE: usize = 2 << 20;
    /// Buffers of at least this size get their own pages, bytes.
    const LARGE: usize = HUGE_PAGE;
    /// Number of freed buffers that are kept at most.
    pub const KEPT_COUNT: usize = 16;

    pub(super) fn is_large(layout: Layout) -> bool {
        layout.size() >= LARGE && layout.align() <= HUGE_PAGE
    }

    /// `size` in whole huge pages.
    pub(super) fn rounded(size: usize) -> usize {
        size.div_ceil(HUGE_PAGE) * HUGE_PAGE
    }

    /// A freed buffer in whole huge pages.
    #[derive(Clone, Copy)]
    pub struct Buffer {
        pub(super) start: *mut u8,
        /// Bytes.
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
    pub fn most_kept() -> usize {
        KEPT_BYTES.max((KEPT_SHARE * LIVE.load(Relaxed) as f64) as usize)
    }

    /// The kept buffers, the oldest first; places without one have length 0.
    static KEPT: Mutex<[Buffer; KEPT_COUNT]> = Mutex::new([Buffer::NONE; KEPT_COUNT]);

    /// What `work` makes of the kept buffers; none while another thread uses them.
    pub fn with_kept<T>(work: impl FnOnce(&mut [Buffer; KEPT_COUNT]) -> T) -> Option<T> {
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
}
