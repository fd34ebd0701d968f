"""Train and test one network: `python -m i2i.train model=i2i task=pose data=shapenet_bed`."""

from omegaconf import DictConfig

from i2i.cli import door


@door("train")
def main(cfg: DictConfig) -> None:
    """Train and test one network, or every job of a sweep."""
    # Torch and Lightning take seconds to import, which --help and a typing error need not wait for.
    from i2i.training import run

    run(cfg)


if __name__ == "__main__":
    main()
