"""How colcon builds and installs the package."""

from setuptools import setup

NAME = "kmn_ros"

setup(
    name=NAME,
    version="0.1.0",
    description="Poses of parts in a bin, from depth images or clouds: a node on top of kmn_jax",
    license="Apache-2.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/poses.launch.py"]),
    ],
    python_requires=">=3.11",
    install_requires=["setuptools"],  # kmn_jax is left to pip: rosdep does not know it
    zip_safe=True,
    entry_points={"console_scripts": [f"poses = {NAME}.node:main"]},
)
