//! The threads of a process.

use mtm_core::pool::{pool_of, run};

#[test]
fn a_process_that_was_not_forked_works_on_its_own_thread() {
    let here = std::thread::current().id();
    assert_eq!(run(|| std::thread::current().id()), Ok(here));
}

#[test]
#[allow(clippy::unwrap_used)]
fn each_process_of_a_line_has_one_pool_of_its_own() {
    let sums: Vec<_> = [11, 12, 13, 12, 11]
        .map(|process| pool_of(process).unwrap())
        .map(|pool| (std::ptr::from_ref(pool), pool.install(|| rayon::join(|| 1, || 2))))
        .to_vec();
    assert!(sums.iter().all(|(_, sum)| *sum == (1, 2)));
    assert_eq!((sums[0].0, sums[1].0), (sums[4].0, sums[3].0));
    assert!(sums[0].0 != sums[1].0 && sums[1].0 != sums[2].0 && sums[0].0 != sums[2].0);
}
