"""The kernels are plain C++ for any processor: they compile for aarch64, and draw alike there."""

from pathlib import Path

NATIVE = Path(__file__).parents[4] / "twin" / "scene" / "native"
KERNELS = ("project", "unproject", "draw", "operate", "structure", "compare", "adam")
SHARED = ("rasteriser", "depth_order", "operators", "dispatch", "similarity", "session")


def test_no_source_names_an_instruction_of_one_processor() -> None:
    sources = [path for path in NATIVE.iterdir() if path.suffix in (".cpp", ".hpp")]
    assert len(sources) > 10
    for path in sources:
        text = path.read_text()
        for foreign in ("immintrin", "_mm256", "_mm512", "_mm_", "arm_neon", "asm("):
            assert foreign not in text, f"{path.name}: {foreign}"


def test_every_kernel_is_compiled() -> None:
    compiled = {path.stem for path in NATIVE.glob("*.cpp")}
    assert compiled == {*KERNELS, *SHARED, "module", "module_session"}
