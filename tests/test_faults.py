"""Every fault of the list has a test that is marked with its number, or a reason why not."""

import re
from pathlib import Path

from faults import FAULTS, LEFT_OUT


def test_every_fault_is_tested_or_left_out_with_a_reason():
    listed = {number for part in FAULTS.values() for number in part}
    tested = {
        int(number)
        for path in Path(__file__).parent.rglob("test_*.py")
        for numbers in re.findall(r"mark\.fault\(([\d, ]+)\)", path.read_text())
        for number in numbers.split(",")
    }
    assert tested <= listed
    assert not tested & LEFT_OUT.keys()
    assert listed - tested == LEFT_OUT.keys()
    assert len(tested) >= 100
