//! Large buffers that are kept.

use std::alloc::{GlobalAlloc, Layout};

use mtm_core::HugePages;
use mtm_core::internals::kept::{KEPT_BYTES, KEPT_COUNT, most_kept, with_kept};

const MB: usize = 1 << 20;

fn layout(size: usize) -> Layout {
    Layout::from_size_align(size, 8).expect("a valid layout")
}

/// Other tests of this process use the system's allocator, so that the kept buffers are those of this one.
#[test]
#[allow(unsafe_code)]
fn freed_buffers_are_used_again_and_cleared() {
    let total =
        || with_kept(|kept| kept.iter().map(|b| b.length).sum::<usize>()).expect("no other user");
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
        let many: Vec<_> = (0..3 * KEPT_COUNT).map(|_| HugePages.alloc(layout(8 * MB))).collect();
        for &buffer in &many {
            buffer.write_bytes(1, 8 * MB);
            HugePages.dealloc(buffer, layout(8 * MB));
            assert!(total() <= most_kept());
        }
        assert_eq!(total(), KEPT_BYTES);
        let again = HugePages.alloc(layout(8 * MB));
        assert!(many[many.len() - 8..].contains(&again));
        HugePages.dealloc(again, layout(8 * MB));
        let small: Vec<_> = (0..3 * KEPT_COUNT).map(|_| HugePages.alloc(layout(2 * MB))).collect();
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
