"""A synthetic head, known exactly: anatomy alone. `cmfsim.lab.virtual` makes cases of it.

`make_head` returns a `PhantomHead` with skin, skull, mandible, teeth, airway, muscles and landmarks
as level functions, label images, CT-like images and closed surfaces; `HeadParameters` give other
people.
"""
