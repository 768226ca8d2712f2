//! Postorders.

use mtm_core::internals::postorder;

#[test]
fn postorder_puts_children_before_parents_and_keeps_subtrees_together() {
    let none = usize::MAX;
    let parents = [4, 4, 3, none, 5, none];
    let order = postorder(&parents);
    assert_eq!(order, [2, 3, 0, 1, 4, 5]);
}
