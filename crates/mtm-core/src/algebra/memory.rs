//! An allocator that requests huge pages for large buffers.
//!
//! Factorisations, tensors and multigrid levels take hundreds of megabytes that are written once and then
//! streamed. With pages of 4 KiB the first access to that memory cost more than the arithmetic on it: the
//! numeric factorisation of 300 000 tets took three times as long. If transparent huge pages are set to
//! `madvise` (Debian, Ubuntu) or `always`, one call per buffer avoids this; elsewhere it has no effect.

use std::alloc::{GlobalAlloc, Layout, System};

/// Size of a huge page on x86-64 and most arm64 systems, bytes.
#[cfg(target_os = "linux")]
const HUGE_PAGE: usize = 2 << 20;
/// Buffers of at least this size get their own pages, bytes.
#[cfg(target_os = "linux")]
const LARGE: usize = HUGE_PAGE;

/// The system's allocator, with huge pages for large buffers on Linux.
///
/// A binary opts in: `#[global_allocator] static MEMORY: HugePages = HugePages;`
pub struct HugePages;

// SAFETY: small requests are passed to the system allocator. Large ones are private anonymous mappings, zeroed
// by the kernel, of at least the requested size and aligned to a huge page (more than any layout requests below
// that); they are unmapped with the same size, computed from the same layout.
#[allow(unsafe_code)]
unsafe impl GlobalAlloc for HugePages {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            return unsafe { map(layout.size()) };
        }
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            return unsafe { map(layout.size()) };
        }
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        #[cfg(target_os = "linux")]
        if is_large(layout) {
            // SAFETY: the mapping was made by `map` with this size.
            unsafe { libc::munmap(pointer.cast(), rounded(layout.size())) };
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

#[cfg(target_os = "linux")]
fn is_large(layout: Layout) -> bool {
    layout.size() >= LARGE && layout.align() <= HUGE_PAGE
}

/// `size` in whole huge pages.
#[cfg(target_os = "linux")]
fn rounded(size: usize) -> usize {
    size.div_ceil(HUGE_PAGE) * HUGE_PAGE
}

/// A zeroed mapping of `size` bytes in whole huge pages, or null.
#[cfg(target_os = "linux")]
#[allow(unsafe_code)]
unsafe fn map(size: usize) -> *mut u8 {
    let length = rounded(size);
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
